"""Training: it learns, it resumes exactly, it stops at nonsense, and it keeps what it promises in its folder."""

import dataclasses
import os
import signal
import socket
import subprocess
import sys
from contextlib import ExitStack
from pathlib import Path
from types import SimpleNamespace
from typing import Literal

import pytest
import torch
import yaml

from asca_pillars.base.errors import ScanError, TrainingError
from asca_pillars.base.schema import to_dict
from asca_pillars.config.pillar import CpaReading, PillarModel
from asca_pillars.config.pv_rcnn import PvRcnnModel
from asca_pillars.config.tree import DataConfig, TrainConfig
from asca_pillars.config.two_stage import RefineModel
from asca_pillars.evaluation.recall import RecallRow, RecallTally
from asca_pillars.models.build import Checkpoint, build_model, load_checkpoint
from asca_pillars.models.pillar.network import PillarDetector
from asca_pillars.models.trainable import Trainable
from asca_pillars.ops.pillar.prepare import PillarLimits
from asca_pillars.scans.input_check import ExpectedInput
from asca_pillars.training.callbacks import SaveOnInterrupt, TrainingInterruptedError
from asca_pillars.training.dataset import Batch, Collate, open_dataset
from asca_pillars.training.loop import syncs_statistics, train
from asca_pillars.training.module import DetectionModule
from tests.helpers.scenes import GROUND_Z_M, SPEC, write_dataset
from tests.helpers.tiny_run import CONFIG, NETWORK, with_train


@pytest.mark.parametrize(
    ("cpa", "neck"), [("paper", "dense"), ("channel", "dense"), ("point", "dense"), ("channel", "sparse")]
)
def test_two_frames_are_learnt_by_heart(tmp_path: Path, cpa: CpaReading, neck: Literal["dense", "sparse"]) -> None:
    torch.manual_seed(0)
    # Few points of a pillar: attention among them takes time by the square of the limit.
    spec = dataclasses.replace(SPEC, limits=PillarLimits(max_pillars=2000, max_points=8))
    model = PillarModel(spec=spec, network=dataclasses.replace(NETWORK, cpa=cpa, neck=neck))
    config = dataclasses.replace(CONFIG, model=model, data=DataConfig(train_set="val", workers=0))
    frames = open_dataset(write_dataset(tmp_path, 2, val_frames=2), config, training=False)
    batch = Collate(frames.preparation)([frames.sample(0, 0), frames.sample(0, 1)])
    assert isinstance(batch, Batch)
    assert sum(len(boxes) for boxes in batch.boxes) == 8
    detector = build_model(config.model)
    optimizer = torch.optim.Adam(detector.parameters(), lr=3e-3)
    for step in range(1, 151):
        optimizer.zero_grad()
        torch.stack(list(detector.loss(detector.predict(batch.inputs), batch.inputs).values())).sum().backward()
        optimizer.step()
        if step % 25 == 0 and not (mistakes := _mistakes(detector, batch)):
            break
    assert not mistakes


def _mistakes(detector: Trainable, batch: Batch) -> dict[str, RecallRow]:
    """Rows of the classes of which an object is missed or made up."""
    tally = RecallTally(SPEC.class_names)
    # Running statistics of the normalization lag behind so few steps: judge with those of the batch.
    with torch.no_grad():
        found = detector.detect(detector.predict(batch.inputs), SPEC)
    for detections, boxes, labels in zip(found, batch.boxes, batch.labels, strict=True):
        tally.add(detections, boxes, labels)
    return {name: row for name, row in tally.rows().items() if (row.recall, row.false) != (1.0, 0)}


def test_run_folder_and_checkpoint(tmp_path: Path) -> None:
    last = train(CONFIG, write_dataset(tmp_path / "data", 5), tmp_path / "run")
    run = tmp_path / "run"
    assert yaml.safe_load((run / "config.yaml").read_text()) == to_dict(CONFIG)
    assert "torch" in (run / "environment.json").read_text()
    names = {path.stem for path in (run / "checkpoints").iterdir()}
    assert names == {"last", "previous", "best", "weights"}
    assert list((run / "tensorboard").glob("events*"))
    checkpoint = load_checkpoint(last)
    assert checkpoint.expected_input is not None and checkpoint.expected_input.camera_view
    assert checkpoint.expected_input.ground_z_m == pytest.approx((GROUND_Z_M, GROUND_Z_M), abs=0.01)
    assert load_checkpoint(last.with_name("weights.ckpt")).expected_input == checkpoint.expected_input
    assert checkpoint.config == CONFIG and checkpoint.steps == 4
    assert isinstance(checkpoint.detector, PillarDetector) and not checkpoint.detector.training


def assert_same_weights(found: Checkpoint, expected: Checkpoint, steps: int) -> None:
    assert found.steps == expected.steps == steps
    weights = expected.detector.state_dict()
    for name, value in found.detector.state_dict().items():
        torch.testing.assert_close(value, weights[name], rtol=1e-5, atol=1e-6, msg=name)


def test_a_longer_run_is_a_finished_run_made_longer(tmp_path: Path) -> None:
    """Also from before the last checkpoint, which was cut short, and with an average of the weights."""
    data = write_dataset(tmp_path / "data", 5)
    config = with_train(epochs=1, learning_rate=1e-2, decay_epochs=1, ema=0.9)
    longer = with_train(epochs=2, learning_rate=1e-2, decay_epochs=1, ema=0.9)
    unbroken = load_checkpoint(train(longer, data, tmp_path / "unbroken"))
    last = train(config, data, tmp_path / "run")
    last.write_bytes(last.read_bytes()[:1000])
    assert_same_weights(load_checkpoint(train(longer, data, tmp_path / "run")), unbroken, steps=4)
    content = torch.load(last, weights_only=True)
    own = content["current_model_state"]["detector.head.scores.weight"]
    assert not torch.equal(own, content["state_dict"]["detector.head.scores.weight"])


def test_the_best_checkpoint_stays_the_best_when_a_run_goes_on(tmp_path: Path) -> None:
    """last.ckpt is from before the validation that best.ckpt is of."""
    data, checkpoints = write_dataset(tmp_path / "data", 3), tmp_path / "run" / "checkpoints"
    train(CONFIG, data, tmp_path / "run")
    for name, score in (("last.ckpt", 1e9), ("best.ckpt", -1.0)):
        content = torch.load(checkpoints / name, weights_only=True)
        (own,) = (state for key, state in content["callbacks"].items() if "'monitor': 'val/loss'" in key)
        own["best_model_score"] = own["current_score"] = torch.tensor(score)
        own["best_model_path"], own["kth_value"] = str(checkpoints / "best.ckpt"), torch.tensor(score)
        own["best_k_models"] = {str(checkpoints / "best.ckpt"): torch.tensor(score)}
        torch.save(content, checkpoints / name)
    before = (checkpoints / "best.ckpt").read_bytes()
    train(with_train(epochs=CONFIG.train.epochs + 1), data, tmp_path / "run")
    assert (checkpoints / "best.ckpt").read_bytes() == before


def test_a_run_that_had_not_begun_measures_its_scans_anew(tmp_path: Path) -> None:
    data, measured = write_dataset(tmp_path / "data", 3), ExpectedInput((1, 2), (0.1, 0.2), None, camera_view=True)
    (tmp_path / "run").mkdir()
    (tmp_path / "run" / "expected_input.yaml").write_text(yaml.safe_dump(to_dict(measured)))
    found = load_checkpoint(train(CONFIG, data, tmp_path / "run")).expected_input
    assert found is not None and found != measured


def test_a_damaged_scan_is_one_line_from_a_loader_process(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    data = write_dataset(tmp_path / "data", 5)
    scan = data / "training" / "velodyne" / "000001.bin"
    scan.write_bytes(b"x" * 33)
    frames = open_dataset(data, CONFIG, training=True)
    assert str(scan) in str(Collate(frames.preparation)([frames[0, 0], frames[0, 1]]))
    config = dataclasses.replace(CONFIG, data=DataConfig(workers=1))
    measured = ExpectedInput((1, 2), (0.1, 0.2), None, camera_view=True)
    monkeypatch.setattr("asca_pillars.training.loop.measure_input", lambda *_, **__: measured)
    with pytest.raises(ScanError, match=r"000001\.bin") as caught:
        train(config, data, tmp_path / "run")
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_who_asks_it_to_stop_is_told_how_to_go_on(
    number: signal.Signals, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    data = write_dataset(tmp_path / "data", 7)
    config = with_train(epochs=1, checkpoint_steps=1000)
    step = DetectionModule.training_step

    def interrupted(self: DetectionModule, batch: Batch, index: int) -> torch.Tensor:
        if self.global_step == 1:
            # Ours alone: Lightning's waits for the other ranks, which wait for this one.
            assert getattr(signal.getsignal(number), "__func__", None) is SaveOnInterrupt._request_stop
            os.kill(os.getpid(), number)
        return step(self, batch, index)

    monkeypatch.setattr(DetectionModule, "training_step", interrupted)
    before = signal.getsignal(number)
    with pytest.raises(TrainingInterruptedError, match="saved at step 2; run the same command to resume"):
        train(config, data, tmp_path / "run")
    assert signal.getsignal(number) is before
    checkpoints = tmp_path / "run" / "checkpoints"
    assert load_checkpoint(checkpoints / "last.ckpt").steps == load_checkpoint(checkpoints / "weights.ckpt").steps == 2


KILLED = """
import os, signal, sys, torch
from asca_pillars.cli.main import main
save = torch.save
def killed(content, file):
    save(content, file)
    if content["global_step"] == 5:  # before it has its name
        os.kill(os.getpid(), signal.SIGKILL)
torch.save = killed
sys.argv = ["asca", *sys.argv[1:]]
main()
"""


def test_killed_run_resumes_exactly(tmp_path: Path) -> None:
    """Kill -9 in the middle of an epoch, start again: the weights are those of a run that was never killed."""
    data = write_dataset(tmp_path / "data", 7)
    config = with_train(epochs=2, schedule="one_cycle")
    unbroken = load_checkpoint(train(config, data, tmp_path / "unbroken"))

    broken = tmp_path / "broken"
    (tmp_path / "config.yaml").write_text(yaml.safe_dump(to_dict(config)))
    command = ["train", str(tmp_path / "config.yaml"), "--data", str(data), "--out", str(broken)]
    # Sums of floats depend on the number of threads, and another test may have changed this process's.
    environment = os.environ | {"OMP_NUM_THREADS": str(torch.get_num_threads())}
    killed = subprocess.run([sys.executable, "-c", KILLED, *command], capture_output=True, env=environment, timeout=120)
    assert killed.returncode == -signal.SIGKILL, killed.stderr
    assert load_checkpoint(broken / "checkpoints" / "last.ckpt").steps == 4, "the first step of the second epoch"
    assert list(broken.rglob(".*")), "it was writing"

    assert_same_weights(load_checkpoint(train(config, data, broken)), unbroken, steps=6)
    assert not list(broken.rglob(".*")), "temporary files of the killed run are left"


def test_recall_is_that_of_all_ranks_together(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """One rank has no car at all, the other finds one of four: the recall is 1/4, not a mean with NaN."""
    module = DetectionModule(CONFIG)
    other = torch.tensor([[4, 1, 2], [0, 0, 0], [0, 0, 0], [3, 0, 0]])  # objects, found, false of each class; frames

    def add_other(counts: torch.Tensor, reduce_op: str) -> torch.Tensor:
        assert reduce_op == "sum"
        return counts + other

    strategy = SimpleNamespace(reduce=add_other)
    module._trainer = SimpleNamespace(strategy=strategy, sanity_checking=True)  # type: ignore[assignment]
    module._fabric = None
    logged: dict[str, float] = {}
    monkeypatch.setattr(module, "log", lambda name, value: logged.update({name: value}))
    module.recall.counts[-1, 0] = 1
    module.on_validation_epoch_end()
    assert logged["val/recall/Car"] == 0.25 and logged["val/false_per_frame/Car"] == 0.5
    assert module.recall.frames == 0


def test_the_first_loss_that_is_not_finite_stops_and_names_term_and_frames(tmp_path: Path) -> None:
    frames = open_dataset(write_dataset(tmp_path, 4), CONFIG, training=True)
    module = DetectionModule(CONFIG)
    assert isinstance(module.detector, PillarDetector)
    with torch.no_grad():
        module.detector.head.get_parameter("boxes.bias").fill_(float("nan"))
    with pytest.raises(TrainingError, match=r"loss term `box` became nan .* frames 000001, 000000"):
        module.training_step(Collate(frames.preparation)([frames.sample(0, 1), frames.sample(0, 0)]), 0)


def test_two_processes_train_together(tmp_path: Path) -> None:
    data = write_dataset(tmp_path / "data", 9)
    (tmp_path / "config.yaml").write_text(yaml.safe_dump(to_dict(with_train(epochs=1))))
    command = [sys.executable, "-m", "asca_pillars.cli", "train", str(tmp_path / "config.yaml"), "--data", str(data)]
    run = subprocess.run(
        [*command, "--out", str(tmp_path / "run"), "--devices", "2"], capture_output=True, text=True, timeout=300
    )
    assert run.returncode == 0, run.stderr
    # Eight training frames, two to a batch, two batches at a time.
    assert load_checkpoint(tmp_path / "run" / "checkpoints" / "last.ckpt").steps == 2


def test_devices_wait_for_each_other_only_where_all_take_part(monkeypatch: pytest.MonkeyPatch) -> None:
    assert not syncs_statistics(PillarModel())  # torch has it on GPUs alone
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    assert syncs_statistics(PillarModel())
    # A device without keypoints skips a step of two stages, see `PvRcnnDetector.predict`.
    assert not syncs_statistics(PvRcnnModel()) and not syncs_statistics(RefineModel())


MEETING_PLACE = "127.0.0.2"  # address of the machine that the others meet at


def free_port(address: str) -> int:
    with socket.socket() as probe:
        try:
            probe.bind((address, 0))
        except OSError:
            pytest.skip(f"this system has no address {address}")
        return int(probe.getsockname()[1])


def test_two_machines_train_together(tmp_path: Path) -> None:
    """As docs/TRAINING.md says, with the environment that torchrun gives what it starts; here on one machine."""
    data, out = write_dataset(tmp_path / "data", 3), tmp_path / "run"
    config = dataclasses.replace(CONFIG, train=TrainConfig(epochs=1, batch_size=1, learning_rate=1e-3))
    (tmp_path / "config.yaml").write_text(yaml.safe_dump(to_dict(config)))
    train = ["-m", "asca_pillars.cli", "train", str(tmp_path / "config.yaml"), "--data", str(data), "--out", str(out)]
    train += ["--devices", "1", "--num-nodes", "2"]
    common = {"MASTER_ADDR": MEETING_PLACE, "MASTER_PORT": str(free_port(MEETING_PLACE)), "TORCHELASTIC_RUN_ID": "none"}
    common |= {"WORLD_SIZE": "2", "LOCAL_WORLD_SIZE": "1", "GROUP_WORLD_SIZE": "2", "LOCAL_RANK": "0"}
    common |= {"OMP_NUM_THREADS": "1", "GLOO_SOCKET_IFNAME": "lo"}
    with ExitStack() as stack:
        machines = [
            stack.enter_context(
                subprocess.Popen(
                    [sys.executable, *train],
                    stdout=subprocess.PIPE,
                    stderr=subprocess.STDOUT,
                    text=True,
                    env=os.environ | common | {"RANK": rank, "GROUP_RANK": rank},
                )
            )
            for rank in "01"
        ]
        try:
            texts = [machine.communicate(timeout=240)[0] for machine in machines]
        finally:
            for machine in machines:
                machine.kill()
    assert [machine.returncode for machine in machines] == [0, 0], "\n".join(texts)
    # Two training frames, one for each machine at a time: one machine alone would take two steps.
    assert load_checkpoint(out / "checkpoints" / "last.ckpt").steps == 1
    assert [text.count("Trained:") for text in texts] == [1, 1]
