import shutil
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from asca_deploy import Detections, Detector
from asca_deploy.benchmark import alternate, compare, measure_matrix
from asca_deploy.benchmark.box_differences import box_difference
from asca_deploy.benchmark.speed_comparison import FRAMES_PER_TURN
from asca_deploy.providers import PROVIDERS
from asca_pillars.base.system import default_threads

Points = NDArray[np.float32]
SCANS = [np.full((count, 4), count, np.float32) for count in (1, 2)]


def detections(*rows: tuple[float, float, int, float]) -> Detections:
    """Boxes of (x, length, label, score)."""
    boxes = np.array([[x, 0, 0, length, 1, 1, 0] for x, length, _, _ in rows], np.float32).reshape(-1, 7)
    labels = np.array([label for *_, label, _ in rows], np.int64)
    return Detections(boxes, np.array([row[3] for row in rows], np.float32), labels, ("Car", "Cyclist"))


def test_one_after_the_other_back_and_forth_on_the_same_scans() -> None:
    calls: list[tuple[str, int]] = []
    runs = {name: lambda scan, name=name: calls.append((name, len(scan))) for name in "ab"}
    times = alternate(runs, SCANS, rounds=2)
    turn = [1, 1, 2, 1, 2]  # one that is not timed, then all scans until there are three at least
    assert calls == [(name, count) for name in "abba" for count in turn]
    assert {name: value.shape for name, value in times.items()} == {"a": (2, 4), "b": (2, 4)}
    assert min(value.min() for value in times.values()) > 0


def test_the_speedup_is_a_ratio_within_a_round(monkeypatch: pytest.MonkeyPatch) -> None:
    """The machine is ten times slower in the second of three rounds, and the ratio does not see it."""
    slow = np.array([[1.0], [10.0], [1.0]])
    times = {"first": 30 * slow * np.ones((3, FRAMES_PER_TURN)), "other": 10 * slow * np.ones((3, FRAMES_PER_TURN))}
    monkeypatch.setattr("asca_deploy.benchmark.speed_comparison.alternate", lambda *_: times)
    first, other = compare({"first": len, "other": len}, SCANS, rounds=3).contestants
    assert (first.speedup.median, first.total_ms.p50, first.fps) == (1, 30, pytest.approx(1000 / 30))
    assert (other.speedup.low, other.speedup.median, other.speedup.high) == (3, 3, 3)


@pytest.mark.parametrize(("names", "scans", "rounds"), [("", SCANS, 1), ("a", [], 1), ("a", SCANS, 0)])
def test_nothing_to_compare(names: str, scans: list[Points], rounds: int) -> None:
    with pytest.raises(ValueError, match="at least one of each"):
        alternate(dict.fromkeys(names, len), scans, rounds)


def test_boxes_are_paired_by_class_and_place() -> None:
    expected = detections((10.0, 4.0, 0, 0.9), (20.0, 4.0, 0, 0.8), (30.0, 2.0, 1, 0.7))
    found = detections((10.1, 4.2, 0, 0.85), (20.0, 4.0, 1, 0.8), (30.0, 2.0, 1, 0.7), (50.0, 4.0, 0, 0.5))
    difference = box_difference([expected], [found])
    assert (difference.pairs, difference.lone) == (2, 3)  # the second of each is of another class, the last is new
    assert difference.center_size_m == pytest.approx(0.2)
    assert difference.score == pytest.approx(0.05)


def test_a_box_has_one_partner_only() -> None:
    two, one = detections((10.0, 4.0, 0, 0.9), (10.2, 4.0, 0, 0.8)), detections((10.1, 4.0, 0, 0.9))
    assert (box_difference([two], [one]).pairs, box_difference([two], [one]).lone) == (1, 1)
    assert box_difference([one], [two]).lone == 1
    assert box_difference([detections()], [detections()]).pairs == 0


def test_matrix_has_a_row_for_everything(tiny_bundle: Path, bundle_copy: Path, scans: list[Points]) -> None:
    other = bundle_copy.rename(bundle_copy.with_name("other"))
    threads = default_threads() + 1
    rows = measure_matrix({"tiny": tiny_bundle, "other": other}, scans, rounds=1, threads=threads)
    assert rows[0].way == ("tiny", "cpu", "float32", threads)
    assert {row.way.provider for row in rows} == set(PROVIDERS)
    assert {row.way.bundle for row in rows} == {"tiny", "other"}
    for row in rows:
        assert (row.speed is None) == (row.boxes is None) == (row.reason is not None)
        if row.boxes is not None and row.way.precision == "float32" and row.way.provider == "cpu":
            assert (row.boxes.pairs, row.boxes.lone) == (sum(len(Detector(tiny_bundle)(scan)) for scan in scans), 0)
            assert row.boxes.center_size_m < 1e-4
    assert {row.way.threads for row in rows if row.way[:3] == ("tiny", "cpu", "float32")} == {1, threads}
    failed = [row.way[:2] for row in rows if row.reason is not None and row.way.precision == "float32"]
    assert len(failed) == len(set(failed))  # said once, not for each number of threads


def test_a_bundle_that_cannot_be_opened_is_a_row(tiny_bundle: Path, tmp_path: Path, scan: Points) -> None:
    broken = Path(shutil.copytree(tiny_bundle, tmp_path / "broken"))
    (broken / "backbone.onnx").write_bytes(b"")
    rows = measure_matrix({"tiny": tiny_bundle, "broken": broken}, [scan], rounds=1)
    (reason,) = {row.reason for row in rows if row.way[:3] == ("broken", "cpu", "float32")}
    assert reason is not None and "backbone.onnx" in reason
