"""Checkpoints of a run: two generations, the one to resume from, and weights that a new run starts from."""

import dataclasses
import signal
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import pytest
import torch

from asca_deploy import shipped
from asca_deploy.shipped import find_checkpoint
from asca_pillars.base import installation
from asca_pillars.base.errors import BundleError, TrainingError
from asca_pillars.base.schema import to_dict
from asca_pillars.config.pillar import PillarModel
from asca_pillars.models.build import Checkpoint, build_model, load_checkpoint
from asca_pillars.models.checkpoint_file import save_weights
from asca_pillars.training.callbacks import AtomicCheckpointIO, BestCheckpoint, checkpoint_to_resume
from asca_pillars.training.loop import train
from tests.helpers.saved_checkpoint import save_checkpoint
from tests.helpers.scenes import write_dataset
from tests.helpers.tiny_run import CONFIG, NETWORK, with_train

MODEL = CONFIG.model


def state_of_a_run(step: int) -> dict[str, Any]:
    weights = {f"detector.{name}": array for name, array in build_model(MODEL).state_dict().items()}
    lists: dict[str, Any] = {"optimizer_states": [], "lr_schedulers": [], "loops": {}, "callbacks": {}}
    return lists | {"global_step": step, "epoch": 0, "state_dict": weights, "pytorch-lightning_version": "2.6"}


def save(folder: Path, step: int, files: AtomicCheckpointIO) -> None:
    files.save_checkpoint(state_of_a_run(step), folder / "last.ckpt")


def step_of(path: Path | None) -> int:
    assert path is not None
    return int(torch.load(path, weights_only=True)["global_step"])


def test_the_last_two_are_kept(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A reader that watches a run (`asca eval`, a copy by rsync) must not find the name gone between two saves."""
    files, last, rename, seen = AtomicCheckpointIO(keep_last=True), tmp_path / "last.ckpt", Path.replace, []

    def watched(source: Path, target: Path) -> Path:
        result = rename(source, target)
        seen.append(last.exists())
        return result

    monkeypatch.setattr(Path, "replace", watched)
    assert checkpoint_to_resume(tmp_path, MODEL) == (None, None)
    for step in (1, 2, 3):
        save(tmp_path, step, files)
    assert seen == [True] * 5
    assert step_of(last) == 3 and step_of(tmp_path / "previous.ckpt") == 2
    assert checkpoint_to_resume(tmp_path, MODEL) == (last, None)
    last.unlink()
    assert checkpoint_to_resume(tmp_path, MODEL) == (tmp_path / "previous.ckpt", None)


def test_a_run_that_was_moved_knows_its_best_loss(tmp_path: Path) -> None:
    before, after = tmp_path / "before", tmp_path / "after"
    after.mkdir()
    callback, loss = BestCheckpoint(before), torch.tensor(0.5)
    callback.best_model_score, callback.best_model_path = loss, str(before / "best.ckpt")
    callback.kth_value, callback.kth_best_model_path = loss, callback.best_model_path
    callback.best_k_models = {callback.best_model_path: loss}
    torch.save({"callbacks": {callback.state_key: callback.state_dict()}}, after / "best.ckpt")
    moved = BestCheckpoint(after)
    strategy = SimpleNamespace(reduce_boolean_decision=lambda decision, **_: decision)
    trainer = cast(Any, SimpleNamespace(global_step=7, strategy=strategy))
    moved.on_train_start(trainer, cast(Any, None))
    assert moved.best_model_path == moved.kth_best_model_path == str(after / "best.ckpt")
    worse, better = torch.tensor(0.6), torch.tensor(0.4)
    assert moved.check_monitor_top_k(trainer, better) and not moved.check_monitor_top_k(trainer, worse)
    others: list[Any] = [{"state_dict": {}}, torch.zeros(3), [1], {"callbacks": 3}]
    for other in others:  # one of another kind is replaced
        torch.save(other, after / "best.ckpt")
        best = BestCheckpoint(after)
        best.on_train_start(trainer, cast(Any, None))
        assert not best.best_k_models


def test_a_full_disk_is_an_error_of_the_system(tmp_path: Path) -> None:
    """Which the command line tells in one line; of torch it would be a RuntimeError."""
    resource = pytest.importorskip("resource", reason="limits of files are those of Unix")
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    handler = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    resource.setrlimit(resource.RLIMIT_FSIZE, (1000, limits[1]))
    try:
        with pytest.raises(OSError, match=r"last\.ckpt"):
            AtomicCheckpointIO(True).save_checkpoint({"weights": torch.zeros(1000)}, tmp_path / "last.ckpt")
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
        signal.signal(signal.SIGXFSZ, handler)
    assert not (tmp_path / "last.ckpt").exists()


@pytest.mark.parametrize("size", [0, -1])
def test_a_truncated_checkpoint_is_passed_over_and_not_kept(tmp_path: Path, size: int) -> None:
    files = AtomicCheckpointIO(keep_last=True)
    for step in (1, 2):
        save(tmp_path, step, files)
    whole = (tmp_path / "last.ckpt").read_bytes()
    (tmp_path / "last.ckpt").write_bytes(whole[:size])
    resumed, damage = checkpoint_to_resume(tmp_path, MODEL)
    assert step_of(resumed) == 1
    assert damage is not None and str(tmp_path / "last.ckpt") in damage and "\n" not in damage
    save(tmp_path, 3, AtomicCheckpointIO(keep_last=False))
    assert step_of(tmp_path / "last.ckpt") == 3 and step_of(tmp_path / "previous.ckpt") == 1


def test_what_is_no_state_of_a_run_is_named(tmp_path: Path) -> None:
    whole, path = state_of_a_run(3) | {"hyper_parameters": {"config": to_dict(CONFIG)}}, tmp_path / "last.ckpt"
    torch.save(whole, tmp_path / "whole.ckpt")
    save_weights(tmp_path / "whole.ckpt", tmp_path / "weights.ckpt")
    weights = torch.load(tmp_path / "weights.ckpt", weights_only=True)
    other = {"detector.encode.linear.weight": torch.zeros(3, 9)}
    for content, message in (
        (weights, r"last\.ckpt holds weights alone, not the state of a run .*--init .*last\.ckpt"),
        (whole["state_dict"], r"last\.ckpt is not a checkpoint of a run"),
        (torch.zeros(3), "is damaged .*it holds a Tensor"),
        ([1, 2], r"last\.ckpt is damaged .*it holds a list.*--init .*best\.ckpt"),
        (whole | {"state_dict": 3}, "is damaged .`state_dict` is a int"),
        (whole | {"loops": "x"}, "is damaged .`loops` is a str"),
        (whole | {"state_dict": whole["state_dict"] | other}, r"another network \(encode\.linear\.weight differs"),
    ):
        torch.save(content, path)
        with pytest.raises(TrainingError, match=message) as caught:
            checkpoint_to_resume(tmp_path, MODEL)
        assert "\n" not in str(caught.value)
        torch.save(whole, tmp_path / "previous.ckpt")
        resumed, wrong = checkpoint_to_resume(tmp_path, MODEL)
        assert resumed == tmp_path / "previous.ckpt" and wrong is not None and wrong.startswith(str(path))
        (tmp_path / "previous.ckpt").unlink()


def test_of_hidden_files_only_those_of_a_killed_run_go(tmp_path: Path) -> None:
    """Jupyter keeps a hidden folder wherever it has opened a file."""
    folder = tmp_path / "run" / "checkpoints"
    (folder / ".ipynb_checkpoints").mkdir(parents=True)
    (folder / ".ipynb_checkpoints" / "notes.ipynb").touch()
    (folder / ".notes").touch()
    data = write_dataset(tmp_path / "data", 3)
    for _ in range(2):
        (folder / ".last.asca-01234567.ckpt").touch()
        with pytest.raises(TrainingError, match="devices many"):
            train(CONFIG, data, tmp_path / "run", devices="many")
        assert sorted(path.name for path in folder.iterdir()) == [".ipynb_checkpoints", ".notes"]
    assert (folder / ".ipynb_checkpoints" / "notes.ipynb").exists()


STILL = with_train(epochs=1, learning_rate=1e-12)
OTHER = dataclasses.replace(CONFIG, model=PillarModel(network=dataclasses.replace(NETWORK, pillar_channels=8)))


def test_a_run_can_start_from_other_weights(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    data, bundle, first = write_dataset(tmp_path / "data", 3), tmp_path / "bundle", tmp_path / "first.ckpt"
    torch.manual_seed(3)
    other = Checkpoint(CONFIG, build_model(CONFIG.model), 7)
    save_checkpoint(first, other)
    bundle.mkdir()
    first_weights = bundle / "weights.ckpt"
    first_weights.write_bytes(first.read_bytes())
    for module in (shipped, installation):
        monkeypatch.setattr(module, "shipped_models", lambda: {"a_model": bundle})
    assert [find_checkpoint(init) for init in (first, bundle, "a_model")] == [first, first_weights, first_weights]
    found = load_checkpoint(train(STILL, data, tmp_path / "run", init=first_weights)).detector.parameters()
    for expected, parameter in zip(other.detector.parameters(), found, strict=True):
        torch.testing.assert_close(parameter, expected)
    for init, error, message in (
        (first, TrainingError, r"another network: \S+ is \(16, 9\) there and \(8, 9\) in this configuration"),
        ("another", BundleError, "no bundle of that name ships"),
        (data, BundleError, r"data: holds no weights\.ckpt, .* a_model has one"),
        (tmp_path / "none.ckpt", TrainingError, "no such checkpoint"),
    ):
        with pytest.raises(error, match=message) as caught:
            train(OTHER, data, tmp_path / "refused", init=find_checkpoint(init))
        assert "\n" not in str(caught.value)
    assert not (tmp_path / "refused").exists()  # the corrected command finds nothing in its way
