"""The tables, notes and JSON of a report, from a small set whose numbers are known.

The picture of the precision-recall curves.
"""

import dataclasses
import io
import json
from functools import cache
from pathlib import Path

import cv2
import numpy as np
import pytest
from rich.console import Console

from asca_pillars.data.kitti import KittiObject
from asca_pillars.evaluation.kitti.average_precision import DIFFICULTIES, METRICS, Curve, KittiResults, evaluate
from asca_pillars.evaluation.kitti.kitti_report import (
    BANDS_M,
    KittiReport,
    kitti_json,
    kitti_notes,
    kitti_tables,
    write_curves,
)
from asca_pillars.evaluation.kitti.objects import FrameObjects, frame_objects
from asca_pillars.evaluation.kitti.score_threshold import best_scores, operating_points
from asca_pillars.evaluation.predictions import ScoredFrames
from asca_pillars.evaluation.report_page import ReportPage

CLASSES = ("Car", "Pedestrian", "Cyclist")


def car(x_m: float, z_m: float, score: float | None = None) -> KittiObject:
    """A car that is high enough in the image for every difficulty, and alone where it is."""
    left = 700 + 12 * x_m
    return KittiObject("Car", 0, 0, 0.1, (left, 150, left + 8, 200), 1.5, 1.6, 3.9, x_m, 1.7, z_m, 0.1, score)


@cache
def report(cars: int = 12, missing: tuple[str, ...] = ()) -> KittiReport:
    """Frames of one car each, every second one 45 m away, all found."""
    places = [(float(index), 45.0 if index % 2 else 20.0) for index in range(cars)]
    truth = [frame_objects(f"{number:06d}", [car(*place)]) for number, place in enumerate(places)]
    found = [frame_objects(f"{number:06d}", [car(*place, 1 - number / 100)]) for number, place in enumerate(places)]
    return KittiReport(
        subject="made up",
        frames=ScoredFrames(tuple(truth), tuple(found), missing),
        ap=evaluate(truth, found, CLASSES, bands_m=tuple(BANDS_M)),
        points=operating_points(truth, found, CLASSES, scores=0.5, difficulties=DIFFICULTIES, bands_m=tuple(BANDS_M)),
        best_scores=best_scores(truth, found, CLASSES),
        about={"model": {"name": "nobody"}},
    )


def page(made: KittiReport) -> ReportPage:
    return ReportPage(made.title, kitti_tables(made), kitti_notes(made))


def cells(made: KittiReport, table: int) -> dict[tuple[str, str], tuple[str, ...]]:
    return {(row[0], row[1]): row[2:] for row in kitti_tables(made)[table].rows}


def test_average_precision_with_counts_and_dashes() -> None:
    """12 of 12 found: KITTI's samples reach index 11 of 40, so R40 = 11/40 and R11 = 3/11 (indices 0, 4 and 8)."""
    rows = cells(report(), 0)
    assert rows["Car", "objects"] == ("12",) * 6
    for metric in ("2D", "BEV", "3D", "AOS"):
        assert rows["Car", metric] == ("27.50",) * 3 + ("27.27",) * 3
        assert rows["Cyclist", metric] == ("-",) * 6
        assert rows["mean", metric] == ("27.50",) * 3 + ("",) * 3
    assert rows["Cyclist", "objects"] == ("-",) * 6


def test_tables_of_bands_recall_and_precision() -> None:
    table = kitti_tables(report())[1]
    assert "R40, moderate" in table.title and "Table 4 of ASCA" in table.title and "Deformable PV-RCNN" in table.title
    rows = {row[0]: row[1:] for row in table.rows}
    # Six cars on either side of 40 m: 5/40. None between 30 and 40 m.
    assert rows["0-40 m"] == ("12.50", "12.50 (6)", "-", "-")
    assert rows["40-80 m"] == rows["30-50 m"] == rows["0-30 m"] == rows["0-40 m"]
    recall, precision = cells(report(), 2), cells(report(), 3)
    # Wilson for 12 of 12: 1 / (1 + 1.96^2 / 12) = 0.7575 at the lower end.
    assert recall["Car", "moderate"] == precision["Car", "moderate"] == ("12", "12", "100.00", "75.75 - 100.00")
    assert recall["Cyclist", "hard"] == ("0", "0", "-", "-")
    assert "Car 0.5 (IoU 0.7)" in kitti_tables(report())[2].title


def test_small_sets_missing_classes_and_markdown() -> None:
    lines = kitti_notes(report())
    assert "Car moderate: only 12 counted objects; a perfect detector gets at most 27.5 R40, 27.3 R11" in lines
    assert "Cyclist: not evaluated, because nothing was detected as one; the means leave the class out" in lines
    assert not any(line.startswith("Car") for line in kitti_notes(report(cars=41)))
    assert any(line.startswith("Car easy: only 40 ") for line in kitti_notes(report(cars=40)))
    assert lines[-1].endswith("in 3D: Car 0.89")  # the last of twelve found, with scores 1.00, 0.99 ...
    lines = page(report()).markdown().splitlines()
    assert "| class | metric | R40 easy | R40 moderate | R40 hard | R11 easy | R11 moderate | R11 hard |" in lines
    widths: list[int] = []
    for line in lines:
        if line.startswith("|"):
            widths.append(line.count("|"))
        elif widths:
            assert len(set(widths)) == 1 and len(widths) > 3
            widths = []
    assert "- Car easy: only 12 counted objects; a perfect detector gets at most 27.5 R40, 27.3 R11" in lines


def test_ignored_detections_are_named_where_they_are_most() -> None:
    """KITTI's tool ignores detections without a 2D box for their lack of height: a precision of 100 % says nothing."""
    made = report()

    def hidden(detections: list[FrameObjects]) -> list[str]:
        points = operating_points(made.frames.truth, detections, CLASSES, scores=0.5, difficulties=DIFFICULTIES)
        notes = kitti_notes(dataclasses.replace(made, points=points))
        return [line for line in notes if "are ignored" in line]

    flat = [dataclasses.replace(frame, bbox=np.full((1, 4), -1.0)) for frame in made.frames.detections]
    assert hidden(list(made.frames.detections)) == hidden(flat) == []
    (line,) = hidden([dataclasses.replace(frame, locations=frame.locations + 50) for frame in flat])
    assert line.startswith("Car: 12 of 12 detections are ignored even at hard")


def test_missing_frames_stand_in_every_form_of_the_report() -> None:
    made = report(missing=("000012", "000013"))
    sentence = (
        "evaluated on 12 of 14 frames: no prediction file for 000012 and 1 other; "
        "a frame without detections needs an empty file"
    )
    console = Console(record=True, width=80, markup=False, file=io.StringIO())
    page(made).print(console)
    assert f"made up: {sentence}" in console.export_text().splitlines()
    assert page(made).markdown().splitlines()[0] == f"# made up: {sentence}"
    content = kitti_json(made)
    assert content["frames"] == 12 and content["frames_asked"] == 14 and content["shortage"] == sentence
    assert content["frames_without_predictions"] == ["000012", "000013"]
    assert kitti_json(report())["shortage"] is None and "12 frames" in page(report()).markdown().splitlines()[0]


def test_recall_and_precision_by_distance() -> None:
    """Of 12 cars every second one is found 45 m away, the others 20 m; detections of these are dropped."""
    made = report()
    near = [
        dataclasses.replace(frame, scores=np.where(frame.distances_m < 30, 0.1, 0.9))
        for frame in made.frames.detections
    ]
    points = operating_points(made.frames.truth, near, CLASSES, scores=0.5, bands_m=tuple(BANDS_M))
    table = kitti_tables(dataclasses.replace(made, points=points))[4]
    assert table.columns == ("distance", *CLASSES)
    assert [row[:2] for row in table.rows] == [
        ("0-40 m", "0.00 / - (6)"),
        ("40-80 m", "100.00 / 100.00 (6)"),
        ("0-30 m", "0.00 / - (6)"),
        ("30-50 m", "100.00 / 100.00 (6)"),
    ]
    assert table.rows[0][2:] == ("- / - (0)",) * 2


def test_the_json_has_kittis_shape_and_no_nan() -> None:
    content = json.loads(json.dumps(kitti_json(report()), allow_nan=False))
    assert content["model"] == {"name": "nobody"}
    assert set(content["results"]) == set(CLASSES)
    for name in CLASSES:
        assert set(content["results"][name]) == set(METRICS)
    assert content["results"]["Cyclist"]["3d"] is None
    result = content["results"]["Car"]["3d"]
    assert result["R40"] == pytest.approx([27.5] * 3) and result["R11"] == pytest.approx([300 / 11] * 3)
    np.testing.assert_array_equal(result["precision"]["moderate"], [1.0] * 12 + [0.0] * 29)
    assert [(band["low_m"], band["high_m"]) for band in content["bands"]] == list(BANDS_M)
    assert content["bands"][0]["mean_3d_moderate_R40"] == pytest.approx(12.5)
    assert content["bands"][0]["results"]["Car"]["bev"]["R40"] == pytest.approx([12.5] * 3)
    by_class = {
        (point["class_name"], point["difficulty"]): point
        for point in content["operating_points"]
        if point["band_m"] is None
    }
    assert len(by_class) == 9 and by_class["Car", "easy"]["found"] == 12
    assert by_class["Cyclist", "easy"]["recall"] is None


def results(precision: list[float]) -> KittiResults:
    padded = np.pad(np.array(precision), (0, 41 - len(precision)))
    none = np.zeros(0)
    counts = none.astype(np.int64)
    curve = Curve("Car", "3d", "moderate", padded, 50, 20, none, counts, counts, counts)
    return KittiResults({("Car", "3d", "moderate"): curve}, ("Car", "Pedestrian"), 1)


def blue(path: Path) -> np.ndarray:
    """Columns of the pixels in the color of the moderate difficulty, in the left half and below the middle."""
    image = np.asarray(cv2.imread(str(path)))
    assert image.shape[1] > 700 and image.shape[0] > 600
    lower_left = image[image.shape[0] // 2 :, : image.shape[1] // 2].astype(int)
    return np.nonzero(np.abs(lower_left - (178, 114, 0)).max(axis=-1) < 40)[1]


def test_a_curve_ends_at_the_highest_recall_reached_and_may_be_empty(tmp_path: Path) -> None:
    """Two curves of precision 1 that reach recall 0.25 and 0.75: the second one is three times as long."""
    for name, samples in (("short", 11), ("long", 31)):
        write_curves(tmp_path / f"{name}.png", results([1.0] * samples), name)
    short, long = blue(tmp_path / "short.png"), blue(tmp_path / "long.png")
    assert len(short) > 50 and len(long) > 50
    assert np.ptp(long) > 1.5 * np.ptp(short)
    write_curves(tmp_path / "empty.png", results([]), "a title that is far too long for the picture " * 9)
    assert np.asarray(cv2.imread(str(tmp_path / "empty.png"))) is not None
