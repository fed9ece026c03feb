"""`asca eval --protocol waymo` as a user meets it."""

import json
from pathlib import Path
from typing import Any

import pytest

from asca_pillars.evaluation.kitti.average_precision import CLASS_NAMES
from tests.cli.eval_runs import evaluate, refusal


def test_waymos_metric_of_labels_against_themselves(
    tmp_path: Path, root: Path, texts: dict[str, Any], capsys: pytest.CaptureFixture[str]
) -> None:
    """With scans at both levels, without them at LEVEL_2; every class and range that has objects gets 100."""
    (texts["predictions"] / "000000.txt").unlink()
    arguments: dict[str, Any] = {"predictions": texts["predictions"], "out": tmp_path / "out", "protocol": "waymo"}
    report = evaluate(**arguments, data=root, json_path=tmp_path / "waymo.json")
    assert json.loads((tmp_path / "waymo.json").read_text()) == report
    assert {path.name for path in (tmp_path / "out").iterdir()} == {"waymo.json", "waymo.md"}
    assert report["frames"] == 2 and {item["class_name"] for item in report["results"]} == set(CLASS_NAMES)
    for item in report["results"]:
        expected = [pytest.approx(100)] * 2 if item["objects"] else [None] * 2
        assert [item["AP"], item["APH"]] == expected
    means = [item["mAP"] for item in report["means"] if item["low_m"] == 0 and item["high_m"] is None]
    assert means == pytest.approx([100, 100])
    assert "LEVEL_1 is not evaluated" not in capsys.readouterr().out
    blind = evaluate(**arguments, labels=texts["labels"])
    assert blind["results"][0]["AP"] is None and blind["results"][4]["AP"] == pytest.approx(100)
    assert blind["frames_without_predictions"] == ["000000"]
    assert "LEVEL_1 is not evaluated" in capsys.readouterr().out


def test_waymos_metric_of_the_shipped_bundle(tmp_path: Path, root: Path) -> None:
    report = evaluate(data=root, out=tmp_path / "out", protocol="waymo")
    assert "default on" in report["subject"] and report["model"]["min_score"] == 0.05
    assert len(list((tmp_path / "out" / "predictions").glob("*.txt"))) == 2
    again = evaluate(predictions=tmp_path / "out" / "predictions", data=root, out=tmp_path / "again", protocol="waymo")
    assert again["results"] == report["results"]


def test_waymos_metric_takes_no_options_of_kittis(tmp_path: Path, root: Path, texts: dict[str, Any]) -> None:
    waymo = {**texts, "protocol": "waymo"}
    assert refusal(tmp_path, **waymo, score=["0.5"]) == (
        "--score 0.5 belongs to --protocol kitti; Waymo's metric goes over all scores: leave it out"
    )
    assert "--gallery 2 belongs to --protocol kitti" in refusal(tmp_path, **waymo, data=root, gallery=2)
