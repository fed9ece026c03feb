"""Training on scans without labels: what is learnt, what is exported, and that it can be done again."""

import json
from pathlib import Path

import numpy as np
import pytest
import torch
import yaml

from asca_deploy import load_bundle
from asca_deploy.detect_scans import detect_scans
from asca_deploy.open_model import RuntimeOptions
from asca_deploy.shipped import find_checkpoint
from asca_export import adapt as module
from asca_export import export_checkpoint
from asca_export.adapt import adapt
from asca_pillars.base.errors import ConfigError, OutputError, ScanError
from asca_pillars.base.schema import to_dict
from asca_pillars.config.tree import load_config
from asca_pillars.models.checkpoint_file import read_checkpoint
from tests.cli.short_drive import SCANS, scan, write_drive
from tests.export.tiny import tiny_checkpoint
from tests.helpers.saved_checkpoint import save_checkpoint
from tests.helpers.scenes import SPEC
from tests.helpers.tiny_run import with_train

THRESHOLDS = {"Car": 0.5, "Pedestrian": 0.4, "Cyclist": 0.3}


@pytest.fixture
def student(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Weights and a training small enough for a test, labelled by `fast`."""
    path, settings = tmp_path / "student.ckpt", tmp_path / "small.yaml"
    save_checkpoint(path, tiny_checkpoint("channel"))
    config = to_dict(with_train(epochs=1, teacher=str(path)))
    config["model"]["spec"] = to_dict(SPEC.with_score_threshold(THRESHOLDS))
    settings.write_text(yaml.safe_dump(config))
    for name, value in {"_STUDENT": str(path), "_LABELLER": "fast", "_CONFIG": settings}.items():
        monkeypatch.setattr(module, name, value)
    monkeypatch.setattr(export_checkpoint, "CALIBRATION_SCANS", 8)
    return path


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    (tmp_path / "scans").mkdir()
    for number in range(10):
        np.save(tmp_path / "scans" / f"{number}.npy", scan(number % SCANS))
    return tmp_path / "scans"


def test_the_boxes_of_the_labeller_are_learnt(tmp_path: Path, student: Path, folder: Path) -> None:
    result = adapt(folder, tmp_path / "mine", frames=5)
    assert (result.train, result.val) == (4, 1)
    lines = [json.loads(line) for line in (tmp_path / "mine_run" / "data" / "labels.jsonl").read_text().splitlines()]
    assert [line["scan"] for line in lines] == ["0.npy", "2.npy", "4.npy", "6.npy", "8.npy"], "evenly spaced"
    chosen = [folder / line["scan"] for line in lines]
    found = detect_scans(chosen, options=RuntimeOptions(bundle="fast"), around=False)
    assert [len(line["boxes"]) for line in lines] == [len(one.detections) for one in found]
    assert sum(result.boxes.values()) == sum(len(one.detections) for one in found) > 5

    bundle = load_bundle(tmp_path / "mine")
    assert bundle.precision == "int8"
    assert {one.name: one.score_threshold for one in bundle.spec.classes} == THRESHOLDS
    last, average = (
        read_checkpoint(tmp_path / "mine_run" / "training" / "checkpoints" / name).weights
        for name in ("last.ckpt", "average.ckpt")
    )
    first = read_checkpoint(student).weights
    name = "head.scores.weight"
    assert not torch.equal(first[name], last[name])
    assert torch.allclose(average[name], (first[name] + last[name]) / 2)

    again = adapt(folder, tmp_path / "mine", frames=5)  # as after a kill: what is trained is not trained again
    assert again.bundle.provenance.weights_sha256 == bundle.provenance.weights_sha256


def test_scans_of_a_recording_are_evenly_spaced(tmp_path: Path, student: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    class StoppedError(Exception):
        pass

    def stop(*_: object, **__: object) -> None:
        raise StoppedError

    monkeypatch.setattr("asca_pillars.training.train.train", stop)
    drive = write_drive(tmp_path / "drive.mcap")
    for frames, numbers in ((SCANS, [0, 1, 2, 3, 4]), (3, [0, 1, 3])):
        with pytest.raises(StoppedError):
            adapt(drive, tmp_path / "mine", frames=frames)
        lines = (tmp_path / "mine_run" / "data" / "labels.jsonl").read_text().splitlines()
        assert [json.loads(line)["scan"] for line in lines] == [f"{number:06d}.npy" for number in numbers]
    np.testing.assert_allclose(np.load(tmp_path / "mine_run" / "scans" / "000001.npy"), scan(1), atol=0.01)


def test_what_is_in_the_way_is_said_at_once(tmp_path: Path, student: Path, folder: Path) -> None:
    (tmp_path / "notes").mkdir()
    (tmp_path / "notes" / "notes.txt").write_text("mine")
    with pytest.raises(OutputError, match="notes"):
        adapt(folder, tmp_path / "notes")
    with pytest.raises(ScanError, match="nowhere"):
        adapt(tmp_path / "nowhere", tmp_path / "mine")
    with pytest.raises(ConfigError, match="topic"):
        adapt(folder, tmp_path / "mine", topic="/lidar")
    assert not (tmp_path / "mine_run").exists()


def test_scans_in_which_nothing_is_found(tmp_path: Path, student: Path) -> None:
    (tmp_path / "empty").mkdir()
    np.save(tmp_path / "empty" / "0.npy", np.array([[10.0, 0, -1.7, 0.2]], np.float32))
    with pytest.raises(ScanError, match="fast finds nothing in 1 scans"):
        adapt(tmp_path / "empty", tmp_path / "mine")


def test_what_ships_is_what_is_adapted() -> None:
    config = load_config(module._CONFIG)
    shipped = load_bundle(find_checkpoint(module._STUDENT).parent)
    assert config.train.teacher == shipped.name
    assert [one.score_threshold for one in config.model.spec.classes] == [
        one.score_threshold for one in shipped.spec.classes
    ]
