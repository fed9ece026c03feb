"""Training: it learns, it resumes exactly, it stops at nonsense, and it keeps what it promises in its folder."""

import dataclasses
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
import torch
import yaml

from asca_pillars.config import AugmentConfig, Config, DataConfig, NetworkConfig, TrainConfig
from asca_pillars.errors import TrainingError
from asca_pillars.evaluation.recall import RecallTally
from asca_pillars.models.checkpoint import load_checkpoint
from asca_pillars.models.pillar.loss import detection_loss
from asca_pillars.models.pillar.pillar_detector import build_detector, frame_maps
from asca_pillars.schema import to_dict
from asca_pillars.training.dataset import Batch, KittiDataset
from asca_pillars.training.loop import DetectionModule, train
from tests.scenes import SPEC, write_dataset

NETWORK = NetworkConfig(pillar_channels=16, block_channels=(16, 24, 32), block_convs=(1, 1, 1), upsample_channels=16)
CONFIG = Config(
    name="tiny",
    detector=SPEC,
    network=NETWORK,
    data=DataConfig(workers=0),
    train=TrainConfig(epochs=2, batch_size=2, learning_rate=1e-3, checkpoint_steps=1),
)


@pytest.mark.parametrize(
    ("cpa", "neck"),
    [("none", "dense"), ("paper", "dense"), ("channel", "dense"), ("point", "dense"), ("channel", "sparse")],
)
def test_two_frames_are_learnt_by_heart(tmp_path: Path, cpa: str, neck: str) -> None:
    torch.manual_seed(0)
    network = dataclasses.replace(NETWORK, cpa=cpa, neck=neck)
    config = dataclasses.replace(CONFIG, network=network, data=DataConfig(train_set="val", workers=0))
    frames = KittiDataset(write_dataset(tmp_path, 2, val_frames=2), config, training=False)
    batch = Batch([frames[0, 0], frames[0, 1]])
    assert sum(len(boxes) for boxes in batch.boxes) == 8
    detector = build_detector(config)
    optimizer = torch.optim.Adam(detector.parameters(), lr=3e-3)
    for _ in range(150):
        optimizer.zero_grad()
        detection_loss(detector(batch.pillars), batch.seen_targets(), config.loss).total.backward()
        optimizer.step()
    tally = RecallTally(SPEC.class_names)
    # Running statistics of the normalization lag behind so few steps: judge with those of the batch.
    with torch.no_grad():
        maps = detector(batch.pillars)
    for frame, (found, cells) in enumerate(frame_maps(maps, batch.pillars)):
        tally.add(SPEC.decode(found, cells), batch.boxes[frame], batch.labels[frame])
    for name, row in tally.rows().items():
        assert (row.recall, row.false) == (1.0, 0), f"{name}: {row}"


def test_run_folder_and_checkpoint(tmp_path: Path) -> None:
    last = train(CONFIG, write_dataset(tmp_path / "data", 5), tmp_path / "run")
    run = tmp_path / "run"
    assert yaml.safe_load((run / "config.yaml").read_text()) == to_dict(CONFIG)
    assert "torch" in (run / "environment.json").read_text()
    assert {path.name for path in (run / "checkpoints").iterdir()} == {"last.ckpt", "best.ckpt"}
    assert list((run / "tensorboard").glob("events*"))
    checkpoint = load_checkpoint(last)
    assert checkpoint.config == CONFIG and checkpoint.steps == 4 and not checkpoint.detector.training


def test_another_config_does_not_enter_a_run(tmp_path: Path) -> None:
    data = write_dataset(tmp_path / "data", 3)
    train(dataclasses.replace(CONFIG, train=dataclasses.replace(CONFIG.train, epochs=1)), data, tmp_path / "run")
    with pytest.raises(TrainingError, match=r"train\.epochs = 1, now train\.epochs = 2"):
        train(CONFIG, data, tmp_path / "run")


def test_a_run_of_an_older_version_goes_on(tmp_path: Path) -> None:
    """Its config.yaml lacks a setting that came later, not the setting's default."""
    data = write_dataset(tmp_path / "data", 3)
    first = train(CONFIG, data, tmp_path / "run")
    path = tmp_path / "run" / "config.yaml"
    older = yaml.safe_load(path.read_text())
    del older["augment"]["insert"]
    path.write_text(yaml.safe_dump(older))
    steps = load_checkpoint(first).steps
    assert load_checkpoint(train(CONFIG, data, tmp_path / "run")).steps == steps


def test_a_run_can_start_from_other_weights(tmp_path: Path) -> None:
    data = write_dataset(tmp_path / "data", 3)
    first = train(CONFIG, data, tmp_path / "first")
    still = dataclasses.replace(CONFIG, train=dataclasses.replace(CONFIG.train, epochs=1, learning_rate=1e-12))
    second = load_checkpoint(train(still, data, tmp_path / "second", init=first))
    for (name, expected), found in zip(
        load_checkpoint(first).detector.named_parameters(), second.detector.parameters(), strict=True
    ):
        torch.testing.assert_close(found, expected, msg=name)
    other = dataclasses.replace(CONFIG, network=dataclasses.replace(NETWORK, pillar_channels=8))
    with pytest.raises(TrainingError, match="weights of another network"):
        train(other, data, tmp_path / "third", init=first)


def test_devices_that_do_not_exist_are_one_line(tmp_path: Path) -> None:
    with pytest.raises(TrainingError, match="devices many x 1 nodes"):
        train(CONFIG, write_dataset(tmp_path / "data", 3), tmp_path / "run", devices="many")


def test_killed_run_resumes_exactly(tmp_path: Path) -> None:
    """Kill -9 in the middle of an epoch, start again: the weights are those of a run that was never killed."""
    data = write_dataset(tmp_path / "data", 33)
    config = dataclasses.replace(
        CONFIG, augment=AugmentConfig(), train=dataclasses.replace(CONFIG.train, epochs=3, schedule="one_cycle")
    )
    unbroken = load_checkpoint(train(config, data, tmp_path / "unbroken"))

    broken = tmp_path / "broken"
    (tmp_path / "config.yaml").write_text(yaml.safe_dump(to_dict(config)))
    command = [sys.executable, "-m", "asca_pillars.cli", "train", str(tmp_path / "config.yaml"), "--data", str(data)]
    process = subprocess.Popen(
        [*command, "--out", str(broken)],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        # Sums of floats depend on the number of threads, and another test may have changed this process's.
        env=os.environ | {"OMP_NUM_THREADS": str(torch.get_num_threads())},
    )
    last = broken / "checkpoints" / "last.ckpt"
    deadline = time.monotonic() + 120
    while not (last.exists() and load_checkpoint(last).steps >= 18):  # of 48, sixteen to an epoch
        assert process.poll() is None and time.monotonic() < deadline, "the run ended before it could be killed"
        time.sleep(0.01)
    os.kill(process.pid, signal.SIGKILL)
    process.wait()
    assert load_checkpoint(last).steps < 48, "killed too late to test anything"

    resumed = load_checkpoint(train(config, data, broken))
    assert resumed.steps == unbroken.steps == 48
    for (name, expected), found in zip(
        unbroken.detector.state_dict().items(), resumed.detector.state_dict().values(), strict=True
    ):
        torch.testing.assert_close(found, expected, rtol=1e-5, atol=1e-6, msg=name)
    assert not list(broken.rglob(".*")), "temporary files of the killed run are left"


def test_the_first_loss_that_is_not_finite_stops_and_names_term_and_frames(tmp_path: Path) -> None:
    frames = KittiDataset(write_dataset(tmp_path, 4), CONFIG, training=True)
    module = DetectionModule(CONFIG)
    with torch.no_grad():
        module.detector.head.boxes.bias.fill_(float("nan"))
    with pytest.raises(TrainingError, match=r"loss term `box` became nan .* frames 000001, 000000"):
        module.training_step(Batch([frames[0, 1], frames[0, 0]]), 0)


def test_samples_do_not_depend_on_what_was_drawn_before(tmp_path: Path) -> None:
    frames = KittiDataset(write_dataset(tmp_path, 4), CONFIG, training=True)
    first = frames[3, 1]
    _ = frames[3, 2], frames[4, 1]
    again = frames[3, 1]
    assert np.array_equal(first.pillars.features, again.pillars.features)
    assert not np.array_equal(frames[4, 1].frame.points[:50], first.frame.points[:50])


def test_two_processes_train_together(tmp_path: Path) -> None:
    data = write_dataset(tmp_path / "data", 9)
    (tmp_path / "config.yaml").write_text(yaml.safe_dump(to_dict(CONFIG)))
    command = [sys.executable, "-m", "asca_pillars.cli", "train", str(tmp_path / "config.yaml"), "--data", str(data)]
    run = subprocess.run(
        [*command, "--out", str(tmp_path / "run"), "--devices", "2"], capture_output=True, text=True, timeout=300
    )
    assert run.returncode == 0, run.stderr
    # Eight training frames, two to a batch, two batches at a time, two epochs.
    assert load_checkpoint(tmp_path / "run" / "checkpoints" / "last.ckpt").steps == 4
