"""`--score`: one number, or numbers of classes, alike in every command that takes it."""

import json
from pathlib import Path
from typing import Any

import pytest

from asca_deploy import Detector, sample_scan_path
from asca_pillars.base.errors import ConfigError
from asca_pillars.cli.options import read_scores
from asca_pillars.evaluation.model import scores_by_class
from asca_pillars.scans.scan_reader import read_scan
from tests.helpers.in_process import invoke, run_here

BUNDLE = "fast"


@pytest.mark.parametrize(
    ("texts", "scores"),
    [
        (None, None),
        (["0.4"], 0.4),
        (["Car=0.4", "Van=with=sign=1e-1"], {"Car": 0.4, "Van=with=sign": 0.1}),
        (["Car=0.4", "Car=0.5"], {"Car": 0.5}),
    ],
)
def test_scores_as_typed(texts: list[str] | None, scores: Any) -> None:
    assert read_scores(texts) == scores


@pytest.mark.parametrize(
    ("texts", "message"),
    [
        *(([text], r"such as Car=0\.35") for text in ("high", "Car=", "=0.4", "Car=high", "")),
        *((texts, "is for every class; give it alone") for texts in (["0.4", "Car=0.5"], ["Car=0.5", "0.4"])),
    ],
)
def test_what_is_no_score(texts: list[str], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        read_scores(texts)


def test_the_others_keep_their_own() -> None:
    own = {"Car": 0.5, "Cyclist": 0.3}
    assert scores_by_class(None, own) == own
    assert scores_by_class(0.2, own) == {"Car": 0.2, "Cyclist": 0.2}
    assert scores_by_class({"Car": 0.1}, own) == {"Car": 0.1, "Cyclist": 0.3}
    with pytest.raises(ConfigError, match="--score Van: no such class; there are Car, Cyclist"):
        scores_by_class({"Van": 0.1}, own)


def test_detect_and_the_detector_agree(tmp_path: Path) -> None:
    scores = ("--score", "Car=0.9", "--score", "Cyclist=0.2")
    invoke("detect", "-b", BUNDLE, "-o", tmp_path, "--no-pictures", *scores)
    boxes = json.loads((tmp_path / "street.json").read_text())["boxes"]
    detector = Detector(BUNDLE, score_threshold={"Car": 0.9, "Cyclist": 0.2})
    expected = detector(read_scan(sample_scan_path()).points)
    assert [box["class"] for box in boxes] == expected.names and len(boxes) > 0
    assert expected.names != Detector(BUNDLE)(read_scan(sample_scan_path()).points).names
    thresholds = {one.name: one.score_threshold for one in detector.spec.classes}
    own = {one.name: one.score_threshold for one in detector.bundle.spec.classes}
    assert thresholds == own | {"Car": 0.9, "Cyclist": 0.2}


@pytest.mark.parametrize(
    ("score", "message"),
    [
        ("Lorry=0.4", "Lorry: no such class; there are Car, Pedestrian, Cyclist"),
        ("Car=1.5", "score_threshold 1.5 of class Car must lie between 0 and 1"),
        ("Car:0.4", "such as Car=0.35"),
    ],
)
def test_mistakes_are_one_line(tmp_path: Path, score: str, message: str) -> None:
    result = run_here("detect", "-b", BUNDLE, "-o", tmp_path / "out", "--score", score)
    assert result.returncode > 1 and result.stderr.count("\n") == 1
    assert message in result.stderr
    assert not (tmp_path / "out").exists()


def test_evaluation_counts_from_the_score_of_each_class(tmp_path: Path, texts: dict[str, Any]) -> None:
    given = ["--predictions", texts["predictions"], "--labels", texts["labels"], "-o", tmp_path / "out"]
    invoke("eval", *given, "--score", "Car=0.95")
    points = json.loads((tmp_path / "out" / "report.json").read_text())["operating_points"]
    assert {point["class_name"]: point["score"] for point in points} == {"Car": 0.95, "Pedestrian": 0.3, "Cyclist": 0.3}
    found = {point["class_name"]: point["found"] for point in points if point["band_m"] is None}
    assert found["Car"] == 0 < found["Pedestrian"]
    assert "no such class" in run_here("eval", *given, "--score", "Lorry=0.5").stderr
