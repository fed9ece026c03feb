import logging
from pathlib import Path
from typing import Any

import numpy as np
import onnxruntime
import pytest
from numpy.typing import NDArray

from asca_deploy import Detections, Detector, load_bundle
from asca_deploy.frame import STAGES
from asca_pillars.errors import BundleError, ConfigError, ScanError
from asca_pillars.geometry.decode import HeadMaps

Points = NDArray[np.float32]


def same(a: Detections, b: Detections) -> bool:
    return all(np.array_equal(getattr(a, name), getattr(b, name)) for name in ("boxes", "scores", "labels"))


def detect_by_hand(bundle: Path, points: Points) -> Detections:
    """The same chain out of plain parts: raw sessions, and a scatter by loop onto fresh zeros."""
    spec = load_bundle(bundle).spec
    pillars = spec.pillarize(points)
    encoder = onnxruntime.InferenceSession(bundle / "encoder.onnx", providers=["CPUExecutionProvider"])
    backbone = onnxruntime.InferenceSession(bundle / "backbone.onnx", providers=["CPUExecutionProvider"])
    feed = {name: getattr(pillars, name) for name in ("features", "pillar_index", "point_counts")}
    (pillar_features,) = encoder.run(["pillar_features"], feed)
    canvas = np.zeros((1, spec.grid.ny + 1, spec.grid.nx + 1, pillar_features.shape[1]), np.float32)
    for features, cell in zip(pillar_features, pillars.cells, strict=True):
        canvas[0, 1 + cell // spec.grid.nx, 1 + cell % spec.grid.nx] = features
    maps = backbone.run(["scores", "boxes", "directions"], {"canvas": canvas})
    return spec.decode(HeadMaps(*(channels_last[0].transpose(2, 0, 1) for channels_last in maps)))


def test_equals_the_chain_by_hand(tiny_bundle: Path, scans: list[Points]) -> None:
    detector = Detector(tiny_bundle)
    for points in scans:
        detections = detector(points)
        assert len(detections) > 3
        assert same(detections, detect_by_hand(tiny_bundle, points))


def test_a_frame_inherits_nothing_from_the_one_before(tiny_bundle: Path, scans: list[Points]) -> None:
    detector = Detector(tiny_bundle)
    first = detector(scans[0])
    assert same(detector(scans[0]), first)
    assert not same(detector(scans[1]), first)
    assert same(detector(scans[1]), Detector(tiny_bundle)(scans[1]))
    detector(np.empty((0, 4), np.float32))
    assert same(detector(scans[0]), first)


def test_stream_yields_in_order(tiny_bundle: Path, scans: list[Points]) -> None:
    detector = Detector(tiny_bundle)
    streamed = []
    for points, detections in zip(scans, detector.stream(iter(scans)), strict=True):
        assert detector.last_frame is not None
        assert detector.last_frame.counts.points == len(points)
        streamed.append(detections)
    assert all(same(a, Detector(tiny_bundle)(p)) for a, p in zip(streamed, scans, strict=True))


@pytest.mark.parametrize("points", [np.empty((0, 4), np.float32), np.full((50, 4), 500.0, np.float32)])
def test_no_point_on_the_grid(bundle_without_counts: Path, points: Points) -> None:
    detector = Detector(bundle_without_counts)  # its encoder cannot run without a point
    detections = detector(points)
    assert len(detections) == 0  # the scores' bias of -3 stays below every threshold on an empty canvas
    assert detections.boxes.shape == (0, 7)
    assert detector.last_frame is not None
    assert detector.last_frame.counts.pillars == 0
    assert detector.last_frame.counts.points_outside == len(points)


def test_one_point(tiny_bundle: Path) -> None:
    detector = Detector(tiny_bundle, score_threshold=0.0)
    point = np.array([[5.0, 0.3, -1.0, 0.5]], np.float32)
    assert same(detector(point), Detector(tiny_bundle, score_threshold=0.0)(point))
    assert detector.last_frame is not None
    assert detector.last_frame.counts.pillars == 1


def test_two_million_points(tiny_bundle: Path, scan: Points) -> None:
    detector = Detector(tiny_bundle)
    mostly_far = np.concatenate([scan, np.full((2_000_000 - len(scan), 4), 900.0, np.float32)])
    assert same(detector(mostly_far), detect_by_hand(tiny_bundle, mostly_far))
    assert detector.last_frame is not None
    assert detector.last_frame.counts.points_outside == 2_000_000 - len(scan)

    crowded = np.tile(scan, (2000, 1))
    assert same(detector(crowded), detect_by_hand(tiny_bundle, crowded))
    counts = detector.last_frame.counts
    limits = detector.spec.limits
    assert counts.points == 2_000_000
    kept = counts.points - counts.points_outside - counts.points_over_limit
    assert 0 < kept <= limits.max_pillars * limits.max_points


def test_non_finite_points_are_dropped_and_counted(tiny_bundle: Path, scan: Points) -> None:
    bad = np.full((4, 4), 5.0, np.float32)
    bad[[0, 1, 2, 3], [0, 1, 2, 3]] = [np.nan, np.inf, -np.inf, np.nan]
    detector = Detector(tiny_bundle)
    clean = detector(scan)
    assert detector.last_frame is not None
    assert detector.last_frame.non_finite_points == 0
    assert same(detector(np.concatenate([bad[:2], scan, bad[2:]])), clean)
    assert detector.last_frame.non_finite_points == 4
    assert detector.last_frame.counts.points == len(scan)


def test_a_value_beyond_float32_counts_as_non_finite(tiny_bundle: Path) -> None:
    detector = Detector(tiny_bundle)
    detector(np.array([[1e300, 0.0, 0.0, 0.5], [5.0, 0.0, -1.0, 0.5]]))
    assert detector.last_frame is not None
    assert detector.last_frame.non_finite_points == 1


def test_any_real_array_will_do_and_is_not_changed(tiny_bundle: Path, scan: Points) -> None:
    detector = Detector(tiny_bundle)
    expected, before = detector(scan), scan.copy()
    assert same(detector(scan.astype(np.float64)), expected)
    assert same(detector(np.asfortranarray(scan)), expected)
    assert same(detector(np.repeat(scan, 2, axis=0)[::2]), expected)
    assert same(detector(scan.tolist()), expected)  # type: ignore[arg-type]
    np.testing.assert_array_equal(scan, before)


@pytest.mark.parametrize(
    ("points", "message"),
    [
        (np.zeros((5, 3)), r"shape \(5, 3\), not \(N, 4\).*append a column of reflectances"),
        (np.zeros((5, 5)), r"shape \(5, 5\), not \(N, 4\)"),
        (np.zeros(4), r"shape \(4,\)"),
        (np.zeros((1, 5, 4)), r"shape \(1, 5, 4\)"),
        (np.array([["a"] * 4]), "not an array of numbers"),
        (None, "shape|not an array of numbers"),
        (np.zeros(3, [("x", "f4"), ("y", "f4")]), "not an array of numbers"),
    ],
)
def test_other_shapes_are_refused(tiny_bundle: Path, points: Any, message: str) -> None:
    with pytest.raises(ScanError, match=message) as caught:
        Detector(tiny_bundle)(points)
    assert "\n" not in str(caught.value)


def test_score_threshold_overrides_every_class(tiny_bundle: Path, scan: Points) -> None:
    usual = Detector(tiny_bundle)(scan)
    strict = Detector(tiny_bundle, score_threshold=0.7)(scan)
    assert 0 < len(strict) < len(usual)
    assert same(strict, usual[usual.scores >= 0.7])
    assert len(Detector(tiny_bundle, score_threshold=1.0)(scan)) == 0


@pytest.mark.parametrize(
    ("options", "name"), [({"score_threshold": 1.5}, "score_threshold 1.5"), ({"threads": 0}, "threads 0")]
)
def test_options_out_of_range_are_refused(tiny_bundle: Path, options: dict[str, Any], name: str) -> None:
    with pytest.raises(ConfigError, match=name):
        Detector(tiny_bundle, **options)


def test_the_number_of_threads_does_not_change_the_boxes(tiny_bundle: Path, scan: Points) -> None:
    assert same(Detector(tiny_bundle, threads=1)(scan), Detector(tiny_bundle, threads=3)(scan))


def test_report(tiny_bundle: Path, scan: Points) -> None:
    detector = Detector(tiny_bundle)
    assert detector.last_frame is None
    assert detector.load_s > 0
    assert detector.provider == "cpu"
    detector(scan)
    report = detector.last_frame
    assert report is not None
    assert tuple(report.times_ms) == STAGES
    assert all(time_ms > 0 for time_ms in report.times_ms.values())
    assert report.total_ms == pytest.approx(sum(report.times_ms.values()))
    assert report.counts == load_bundle(tiny_bundle).spec.pillarize(scan).stats
    assert report.warnings == ()


def test_odd_scans_are_reported_each_time_and_logged_once(
    tiny_bundle: Path, scan: Points, caplog: pytest.LogCaptureFixture
) -> None:
    detector = Detector(tiny_bundle)
    detector(scan)
    assert not caplog.records
    scan[:, 3] *= 255
    with caplog.at_level(logging.WARNING):
        for _ in range(2):
            detector(scan)
            assert detector.last_frame is not None
            (warning,) = detector.last_frame.warnings
            assert "divide it by 255" in warning
    assert len(caplog.records) == 1
    assert "divide it by 255" in caplog.text


def test_only_declared_inputs_are_fed(tiny_bundle: Path, bundle_without_counts: Path, scan: Points) -> None:
    assert same(Detector(bundle_without_counts)(scan), Detector(tiny_bundle)(scan))


def test_without_a_bundle_the_shipped_one_is_meant(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr("asca_deploy.bundle.default_bundle_path", lambda: tmp_path / "shipped")
    with pytest.raises(BundleError, match="shipped is no model bundle"):
        Detector()
