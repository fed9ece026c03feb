import logging
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
import onnxruntime
import pytest
from numpy.typing import NDArray

from asca_deploy import Detections, Detector
from asca_deploy.manifest import load_pillar_bundle
from asca_pillars.base.errors import BundleError, ConfigError, ScanError
from asca_pillars.detection.decode import HeadMaps
from asca_pillars.ops.pillar.prepare import PillarCounts
from asca_pillars.scans.mounting import Mounting
from tests.deploy.conftest import STAGES, make_scan
from tests.helpers.same_detections import same

Points = NDArray[np.float32]


def detect_by_hand(bundle: Path, points: Points) -> Detections:
    """The same chain out of plain parts: raw sessions, and a scatter by loop onto fresh zeros."""
    spec = load_pillar_bundle(bundle).spec
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


def test_equals_the_chain_by_hand(tiny_bundle: Path, bundle_without_counts: Path, scans: list[Points]) -> None:
    detectors = Detector(tiny_bundle), Detector(tiny_bundle, threads=3), Detector(bundle_without_counts)
    for points in scans:
        expected = detect_by_hand(tiny_bundle, points)
        assert len(expected) > 3
        assert all(same(detector(points), expected) for detector in detectors)


def test_a_frame_inherits_nothing_from_the_one_before(tiny_bundle: Path, scans: list[Points]) -> None:
    detector = Detector(tiny_bundle)
    first = detector(scans[0])
    assert same(detector(scans[0]), first)
    assert not same(detector(scans[1]), first)
    assert same(detector(scans[1]), Detector(tiny_bundle)(scans[1]))
    detector(np.empty((0, 4), np.float32))
    assert same(detector(scans[0]), first)


@pytest.mark.parametrize("points", [np.empty((0, 4), np.float32), np.full((50, 4), 500.0, np.float32)])
def test_no_point_on_the_grid(bundle_without_counts: Path, points: Points) -> None:
    detector = Detector(bundle_without_counts)  # its encoder cannot run without a point
    detections = detector(points)
    assert len(detections) == 0  # the scores' bias of -3 stays below every threshold on an empty canvas
    assert detections.boxes.shape == (0, 7)
    assert detections.report.counts == PillarCounts(len(points), len(points), 0, 0, 0)


def test_two_million_points(tiny_bundle: Path, scan: Points) -> None:
    detector = Detector(tiny_bundle)
    far = np.full((1_000_000, 4), [900, 900, 900, 0.5], np.float32)
    crowded = np.concatenate([np.tile(scan, (1000, 1)), far])
    detections = detector(crowded)
    assert same(detections, detect_by_hand(tiny_bundle, crowded))
    counts, limits = detections.report.counts, load_pillar_bundle(tiny_bundle).spec.limits
    assert isinstance(counts, PillarCounts) and counts.points == 2_000_000
    assert counts.points_outside == len(far) + 1000 * detector(scan).report.counts.points_outside
    assert (
        0 < counts.points - counts.points_outside - counts.points_over_limit <= limits.max_pillars * limits.max_points
    )


def test_non_finite_points_are_dropped_and_counted(tiny_bundle: Path, scan: Points) -> None:
    bad = np.full((5, 4), 5.0)
    bad[[0, 1, 2, 3, 4], [0, 1, 2, 3, 0]] = [np.nan, np.inf, -np.inf, np.nan, 1e300]  # the last one in float32
    detector = Detector(tiny_bundle)
    clean, repaired = detector(scan), detector(np.concatenate([bad[:2], scan, bad[2:]]))
    assert same(repaired, clean)
    assert (clean.report.non_finite_points, repaired.report.non_finite_points) == (0, 5)
    assert "5 points are not finite and were dropped" in repaired.report.warnings
    assert not any("not finite" in text for text in clean.report.warnings)
    assert repaired.report.counts.points == len(scan)


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
        (np.zeros((4, 9)), r"shape \(4, 9\), .*transpose it: points\.T"),
        (np.zeros((1, 5, 4)), r"shape \(1, 5, 4\)"),
        (np.array([["a"] * 4]), "not an array of numbers"),
        ([[10**400, 0, 0, 0]], "not an array of numbers"),
        ([[1, 2, 3, 4], [1, 2]], "not an array of numbers"),
        (np.zeros((5, 4), complex), "not an array of numbers, but of type complex128"),
        (np.ma.masked_equal(np.zeros((5, 4)), 0), "masked array"),
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
    ("options", "name"),
    [
        ({"score_threshold": 1.5}, "score_threshold 1.5"),
        ({"score_threshold": "0.5"}, "score_threshold '0.5': give a number"),
        ({"mounting": {"axes": "x-forward"}}, r"mounting {'axes': .*: give Mounting"),
        ({"threads": 2.0}, "threads 2.0 must lie between 1 and"),
        ({"threads": 0}, "threads 0 must lie between 1 and"),
        ({"threads": 99_999_999_999}, "threads 99999999999 must lie"),
        ({"view": "behind"}, "view behind: give ahead or around"),
    ],
)
def test_options_out_of_range_are_refused(tiny_bundle: Path, options: dict[str, Any], name: str) -> None:
    with pytest.raises(ConfigError, match=name):
        Detector(tiny_bundle, **options)


def test_report(tiny_bundle: Path, scan: Points) -> None:
    detector = Detector(tiny_bundle)
    assert detector.load_s > 0
    assert (detector.provider, detector.runs_on) == ("cpu", "cpu float32")
    report = detector(scan).report
    assert tuple(report.times_ms) == ("input", *STAGES)
    assert all(time_ms > 0 for time_ms in report.times_ms.values())
    assert report.total_ms == pytest.approx(sum(report.times_ms.values()))
    assert report.counts == load_pillar_bundle(tiny_bundle).spec.pillarize(scan).stats
    assert report.warnings == ()


def test_odd_scans_are_reported_each_time_and_logged_once(
    tiny_bundle: Path, scan: Points, caplog: pytest.LogCaptureFixture
) -> None:
    detector = Detector(tiny_bundle)
    detector(scan)
    assert not caplog.records
    scan[:, 3] *= 255
    with caplog.at_level(logging.WARNING, logger="asca_pillars"):  # `asca detect` silences it
        for _ in range(2):
            warning, repair = detector(scan).report.warnings
            assert "divide it by 255" in warning and "set to the nearer end" in repair
    assert len(caplog.records) == 2
    assert "divide it by 255" in caplog.text


@pytest.mark.parametrize("reflectance", [1.02, 255.0, 3e38, -1e6, -0.01])
@pytest.mark.parametrize("axes", ["x-forward", "y-forward"])
def test_reflectances_outside_the_unit_range_are_clipped_and_counted(
    tiny_bundle: Path, scan: Points, reflectance: float, axes: str
) -> None:
    detector = Detector(tiny_bundle, mounting=Mounting(axes=axes))
    odd, clipped = scan.copy(), scan.copy()
    odd[5, 3], clipped[5, 3] = reflectance, np.clip(reflectance, 0, 1)
    detections = detector(odd)
    assert same(detections, detector(clipped))
    assert detections.report.clipped_reflectances == 1
    assert any("1 reflectances lie outside 0..1" in warning for warning in detections.report.warnings)
    assert odd[5, 3] == np.float32(reflectance)  # the caller's array stays as it is


@pytest.mark.parametrize("far", [1e5, 3e38, -3e38])
def test_absurd_coordinates_are_outside(tiny_bundle: Path, far: float) -> None:
    detector, scan = Detector(tiny_bundle), make_scan(0, 150)  # within the limits: no subset is drawn
    odd = np.concatenate([scan, np.array([[far, far, 0, 0.5], [5, 0, far, 0.5]], np.float32)])
    detections, expected = detector(odd), detector(scan)
    assert same(detections, expected)
    assert detections.report.counts.points_outside == expected.report.counts.points_outside + 2


def test_what_is_not_finite_in_the_networks_answer_is_left_out_and_counted(
    tiny_bundle: Path, scan: Points, monkeypatch: pytest.MonkeyPatch
) -> None:
    detector = Detector(tiny_bundle)
    clean = detector(scan)
    infer = detector.pipeline.infer

    def overflow(*arguments: Any) -> Any:
        answer = infer(*arguments)
        maps = answer.maps
        maps.scores[0, 0, :3] = np.nan, np.inf, -np.inf
        best = np.unravel_index(maps.scores[:, 1:].argmax(), maps.scores[:, 1:].shape)
        maps.boxes[7 * best[0], best[1] + 1, best[2]] = np.nan
        return answer

    monkeypatch.setattr(detector.pipeline, "infer", overflow)
    detections = detector(scan)
    assert detections.report.non_finite_outputs == detections.non_finite == 4
    assert "not finite at 4 anchors" in detections.report.warnings[-1]
    assert np.isfinite(detections.boxes).all() and np.isfinite(detections.scores).all()
    assert not same(detections, clean)


def test_one_detector_in_eight_threads_gives_each_its_own_boxes(tiny_bundle: Path) -> None:
    detector = Detector(tiny_bundle)
    scans = [make_scan(seed, 400 + 60 * seed) for seed in range(10)]
    expected = [detector(points) for points in scans]
    with ThreadPoolExecutor(8) as threads:
        found = list(threads.map(detector, scans * 20))
    for detections, alone in zip(found, expected * 20, strict=True):
        assert same(detections, alone)
        assert detections.report.counts == alone.report.counts


def test_the_points_are_remembered_as_long_as_the_caller_keeps_them(tiny_bundle: Path) -> None:
    points = make_scan()
    detections = Detector(tiny_bundle)(points)
    assert detections._repr_png_() is not None and "<img" in detections._repr_html_()
    with_points = detections.plot()
    np.testing.assert_array_equal(detections.plot(points), with_points)
    del points
    assert detections._repr_png_() is None and "<img" not in detections._repr_html_()
    assert detections.plot().shape[2] == 3 and not np.array_equal(detections.plot(), with_points)


def test_without_a_bundle_the_shipped_one_is_meant(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr("asca_deploy.shipped.default_bundle_path", lambda: tmp_path / "shipped")
    with pytest.raises(BundleError, match="shipped is not a model bundle"):
        Detector()
