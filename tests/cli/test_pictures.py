"""Pictures that commands write: training frames, and detections beside labels."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import yaml

from asca_pillars.base.errors import ConfigError, OutputError
from asca_pillars.base.schema import to_dict
from asca_pillars.config.pillar import PillarModel
from asca_pillars.config.tree import Config, DataConfig
from asca_pillars.data.augment import open_frames
from asca_pillars.detection.anchors import ClassSpec
from asca_pillars.pictures.training_pictures import draw_training_frame
from asca_pillars.pictures.visualize import class_color, read_image
from tests.data.boxes.box_scenes import write_box_dataset
from tests.helpers.in_process import invoke
from tests.helpers.scenes import SPEC

CLASSES = (SPEC.classes[0], ClassSpec("Forklift", 0.8, 0.6, 1.73, -0.87, 0.35, 0.2))
CONFIG = Config(model=PillarModel(spec=replace(SPEC, classes=CLASSES)), data=DataConfig(workers=0))


def has_color(image: np.ndarray, color: tuple[int, int, int]) -> bool:
    """Whether some pixels are nearly of a color: lines are smoothed."""
    return bool((np.abs(image.astype(int) - color).max(axis=2) < 12).sum() > 20)


def test_training_frames_are_drawn_as_training_sees_them(tmp_path: Path) -> None:
    root, out = write_box_dataset(tmp_path / "own", 5), tmp_path / "pictures"
    (tmp_path / "config.yaml").write_text(yaml.safe_dump(to_dict(CONFIG)))
    output = invoke("inspect", root, "-c", tmp_path / "config.yaml", "--draw", 2, "--out", out)
    assert sorted(path.name for path in out.iterdir()) == ["00_000000.png", "01_000002.png", "inspection.json"]
    assert f"{out}/00_000000.png: " in output and "turned by" in output
    frames = open_frames(root, CONFIG, training=True)
    picture = read_image(out / "01_000002.png")
    assert picture is not None
    np.testing.assert_array_equal(picture, draw_training_frame(frames.draw(0, 2)[0], frames))
    assert has_color(picture, class_color("Car")) and has_color(picture, class_color("Forklift"))
    plain = replace(frames, augmentation=None)
    assert not np.array_equal(picture, draw_training_frame(plain.draw(0, 2)[0], plain))
    invoke("inspect", root, "-c", tmp_path / "config.yaml", "--draw", 1, "--out", out)
    assert json.loads((out / "inspection.json").read_text())["files"] == ["00_000000.png"]
    (out / "mine.txt").write_text("kept")
    with pytest.raises(OutputError, match=r"mine\.txt"):
        invoke("inspect", root, "-c", tmp_path / "config.yaml", "--draw", 1, "--out", out)
    with pytest.raises(ConfigError, match="is for the pictures of --draw"):
        invoke("inspect", root, "-c", tmp_path / "config.yaml", "--out", out)


def test_detections_are_drawn_beside_labels_if_these_can_be_read(tmp_path: Path) -> None:
    def detect(root: Path, name: str) -> str:
        scan = root / "scans" / "000000.bin"
        return " ".join(invoke("detect", scan, "-b", "fast", "--out", tmp_path / name).split())

    root, other = (write_box_dataset(tmp_path / name, 2) for name in ("own", "other"))
    detect(root, "with")
    (root / "dataset.yaml").unlink()
    detect(root, "without")
    labelled, plain = (read_image(tmp_path / name / "000000_bev.png") for name in ("with", "without"))
    assert labelled is not None and plain is not None
    assert labelled.shape != plain.shape or not np.array_equal(labelled, plain)
    (other / "labels.jsonl").write_text("{")
    assert "labels are not drawn" in detect(other, "damaged") and (tmp_path / "damaged" / "000000.json").exists()
