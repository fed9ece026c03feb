"""Own classes on scans without a camera, end to end: propose, train, eval, export, detect."""

import json
from dataclasses import replace
from pathlib import Path

import yaml

from asca_deploy import Detector
from asca_pillars.base.schema import to_dict
from asca_pillars.data.boxes.box_split import BoxSplit
from asca_pillars.models.checkpoint import load_checkpoint
from asca_pillars.scans.scan_reader import read_scan
from tests.data.boxes.box_scenes import write_box_dataset
from tests.helpers.in_process import invoke
from tests.helpers.tiny_run import CONFIG


def test_from_boxes_to_a_detector(tmp_path: Path) -> None:
    root = write_box_dataset(tmp_path / "own", 14, val_frames=2)
    config = replace(CONFIG, train=replace(CONFIG.train, epochs=1, batch_size=4))
    (tmp_path / "base.yaml").write_text(yaml.safe_dump(to_dict(config)))
    invoke("inspect", root, "-c", tmp_path / "base.yaml", "--propose", tmp_path / "own.yaml")
    invoke("prepare", tmp_path / "own.yaml", "--data", root, "--workers", 1)
    insert = ("-s", "augment.insert.method=rs_aug")
    invoke("train", tmp_path / "own.yaml", "--data", root, "--out", tmp_path / "run", *insert)

    checkpoint = tmp_path / "run" / "checkpoints" / "last.ckpt"
    loaded = load_checkpoint(checkpoint)
    assert loaded.config.model.spec.class_names == ("Car", "Forklift")
    assert loaded.expected_input is not None and not loaded.expected_input.camera_view

    out = tmp_path / "evaluation"
    invoke("eval", checkpoint, "--data", root, "--out", out, "--min-score", 0.001)
    report = json.loads((out / "iou.json").read_text())
    everywhere = [item for item in report["at_score"] if item["band"] == "all"]
    assert {item["class_name"]: item["objects"] for item in everywhere} == {"Car": 2, "Forklift": 2}

    invoke("export", checkpoint, "-o", tmp_path / "bundle", "--scans", root / "scans")
    detector = Detector(tmp_path / "bundle", score_threshold=0.001)
    found = detector(read_scan(root / "scans" / "000013.bin").points)
    assert found.class_names == ("Car", "Forklift")
    assert BoxSplit(root, "val").frame_ids == ("000012", "000013")
