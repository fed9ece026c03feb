import io
import json
import shutil
import sys
from contextlib import redirect_stdout
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from asca_deploy import Detections, Detector
from asca_deploy.benchmark import (
    alternate,
    bench_report,
    benchmark,
    cold_start,
    compare,
    measure_matrix,
    measure_roofline,
    measure_scaling,
    measure_throughput,
)
from asca_deploy.benchmark.speed_comparison import FRAMES_PER_TURN, box_difference
from asca_deploy.benchmark.timing import FRAMES, SIZE, Percentiles, gemm_rate, resample
from asca_deploy.manifest import load_pillar_bundle
from asca_deploy.providers import PROVIDERS
from asca_pillars.base.errors import AscaError
from asca_pillars.base.system import default_threads
from asca_pillars.geometry.frame_change import FrameChange
from asca_pillars.ops.pillar.prepare import PillarCounts
from asca_pillars.scans.mounting import Mounting, read_pose
from tests.deploy.conftest import STAGES

Points = NDArray[np.float32]


def test_report(tiny_bundle: Path, scans: list[NDArray[np.float32]]) -> None:
    report = benchmark(Detector(tiny_bundle, threads=1), scans, rounds=4, warmup=1)
    assert report.frames == 4 * len(scans)
    assert tuple(report.stages_ms) == ("input", *STAGES)
    for times in (report.total_ms, *report.stages_ms.values()):
        assert 0 < times.min <= times.p50 <= times.p95
    assert report.fps == pytest.approx(1000 / report.total_ms.p50)
    assert report.total_ms.min >= sum(times.min for times in report.stages_ms.values())
    assert report.outside_ms.p50 < report.total_ms.p50 - report.stages_ms["neck+head"].min
    assert 0 < report.outside_share < 1
    assert report.cold_ms > 0
    assert report.points == tuple(len(scan) for scan in scans)
    assert report.detections == tuple(len(Detector(tiny_bundle)(scan)) for scan in scans)
    assert (report.provider, report.threads) == ("cpu", 1)
    assert report.peak_memory_mib is None or 20 < report.peak_memory_mib < 1e6
    written = json.loads(json.dumps(report.to_dict()))
    assert set(written["total_ms"]) == set(written["stages_ms"]["decode"]) == {"p50", "p95", "p99", "min", "max"}
    assert written["versions"]["onnxruntime"] and written["cpu"]


def test_the_input_hash_tells_scans_apart(tiny_bundle: Path, scans: list[NDArray[np.float32]]) -> None:
    hashes = [benchmark(Detector(tiny_bundle), [s], rounds=1, warmup=0).input_sha256 for s in (*scans, scans[0])]
    assert len(set(hashes)) == 3
    assert hashes[0] == hashes[3]


@pytest.mark.parametrize(("count", "rounds"), [(0, 3), (1, 0)])
def test_nothing_to_measure(tiny_bundle: Path, scans: list[NDArray[np.float32]], count: int, rounds: int) -> None:
    with pytest.raises(ValueError, match="at least one of each"):
        benchmark(Detector(tiny_bundle), scans[:count], rounds=rounds)


def test_points_are_made_of_the_scan_and_noisy_copies(scan: Points) -> None:
    before, own = scan.copy(), {tuple(point) for point in scan.tolist()}
    some, more = resample(scan, 100), resample(scan, 5000)
    np.testing.assert_array_equal(scan, before)
    np.testing.assert_array_equal(some, resample(scan, 100))
    assert some.shape == (100, 4) and some.dtype == np.float32 and {tuple(point) for point in some.tolist()} <= own
    rows = {tuple(point) for point in more.tolist()}
    assert more.shape == (5000, 4) and own <= rows and len(rows) > 4900
    assert np.isin(more[:, 3], scan[:, 3]).all()  # reflectances get no noise
    with pytest.raises(ValueError, match="without points"):
        resample(scan[:0], 10)


def test_scaling_has_a_row_for_each_size(tiny_bundle: Path, scan: Points) -> None:
    rows = measure_scaling(Detector(tiny_bundle), scan, counts=(10, 100, 3000), rounds=2)
    assert [row.points for row in rows] == [10, 100, 3000]
    assert rows[0].pillars < rows[1].pillars <= rows[2].pillars <= 300
    for row in rows:
        assert tuple(row.stages_ms) == ("input", *STAGES) and row.total_ms > 0


def test_pillars_of_turned_passes_are_those_of_a_pass(tiny_bundle: Path, scan: Points) -> None:
    around = np.concatenate([FrameChange.turn(quarter * np.pi / 2).points(scan) for quarter in range(4)])
    detector = Detector(tiny_bundle, view="around")
    (row,) = measure_scaling(detector, around, counts=(200,), rounds=1)
    summed = detector(resample(around, 200)).report.counts
    assert isinstance(summed, PillarCounts) and detector.passes > 1
    assert 0 < row.pillars == round(summed.pillars / detector.passes) < 200


def test_throughput_of_stream_and_single_calls(
    tiny_bundle: Path, scan: Points, monkeypatch: pytest.MonkeyPatch
) -> None:
    sizes: list[int] = []
    of = Percentiles.of
    monkeypatch.setattr(Percentiles, "of", lambda times: sizes.append(len(times)) or of(times))
    found = measure_throughput(Detector(tiny_bundle), [scan], rounds=3)
    assert sizes == [3 * FRAMES, 3 * FRAMES], "every streamed frame counts but the first"
    assert min(found.single_fps, found.stream_fps, found.single_latency_ms.p50, found.stream_latency_ms.p50) > 0
    assert found.gain.low <= found.gain.median <= found.gain.high


@pytest.mark.parametrize("kind", ["float32", "int8"])
def test_the_product_of_matrices_runs_and_its_rate_is_counted_in_macs(
    kind: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    clock = iter(range(1000))
    monkeypatch.setattr("asca_deploy.benchmark.timing.perf_counter", lambda: next(clock))  # one second a product
    assert gemm_rate(kind, threads=1, rows=4) == pytest.approx(4 * SIZE * SIZE / 1e9)


def test_roofline(tiny_bundle: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    rates = {"float32": 100.0, "int8": 400.0}
    monkeypatch.setattr("asca_deploy.benchmark.timing.gemm_rate", lambda kind, threads: rates[kind] * threads)
    bundle = replace(load_pillar_bundle(tiny_bundle), backbone_gmac=5.0)
    found = measure_roofline(bundle, backbone_ms=50.0, threads=2)
    assert found.achieved_gmac_s == pytest.approx(100)
    assert (found.type, found.share) == ("float32", pytest.approx(0.5))
    assert measure_roofline(replace(bundle, precision="int8"), backbone_ms=50.0, threads=2).share == pytest.approx(
        100 / 800
    )


def here(code: str, *arguments: object) -> str:
    with pytest.MonkeyPatch.context() as patch, redirect_stdout(io.StringIO()) as out:
        patch.setattr(sys, "argv", ["-c", *map(str, arguments)])
        exec(code, {})
    return out.getvalue()


POSE = ((0.0, 1.0, 0.0, 0.5), (-1.0, 0.0, 0.0, 0.0), (0.0, 0.0, 1.0, 0.1), (0.0, 0.0, 0.0, 1.0))


@pytest.mark.parametrize("mounting", [Mounting(1.6, axes="-y,x,z"), Mounting(pose=POSE)])
def test_new_processes_have_the_mounting_of_the_detector(
    tiny_bundle: Path, scan: Points, mounting: Mounting, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A process of its own runs for one of them; for the other its program runs here, which takes no seconds."""
    seen: list[Mounting] = []
    run = bench_report._run if mounting.pose is None else here

    def spy(code: str, *arguments: object) -> str:
        if code == bench_report._DETECT:
            options = dict(zip(map(str, arguments[3::2]), map(str, arguments[4::2]), strict=True))
            height = float(options["--sensor-height"]) if "--sensor-height" in options else None
            pose = read_pose(options["--pose"]) if "--pose" in options else None
            seen.append(Mounting(height, options.get("--axes", "x-forward"), pose))
        else:
            seen.append(Mounting(**json.loads(str(arguments[-1]))))
        return run(code, *arguments)

    monkeypatch.setattr(bench_report, "_run", spy)
    found = cold_start(Detector(tiny_bundle, threads=1, mounting=mounting), scan, repeats=1)
    assert seen == [mounting, mounting]
    assert found.first_boxes_s >= found.import_s + found.load_s + found.first_scan_s
    assert min(found.import_s, found.load_s, found.first_scan_s) > 0
    assert found.detect_peak_memory_mib is None or 20 < found.detect_peak_memory_mib < 1e5


def test_a_new_process_that_fails_says_why(bundle_copy: Path, scan: Points) -> None:
    detector = Detector(bundle_copy)
    (bundle_copy / "bundle.json").unlink()
    with pytest.raises(AscaError, match="not a model bundle"):
        cold_start(detector, scan, repeats=1)


def test_memory_now_and_at_most(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    resident, peak = bench_report.resident_mib(), bench_report.peak_memory_mib()
    assert resident is None or (peak is not None and 10 < resident <= peak + 1)
    monkeypatch.setattr(bench_report, "STATUS", tmp_path / "none")  # a system without /proc
    peak = bench_report.peak_memory_mib()
    assert bench_report.resident_mib() is None and (peak is None or peak > 10)


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
