import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from asca_deploy import Detector
from asca_deploy.benchmark import (
    bench_report,
    benchmark,
    cold,
    cold_start,
    measure_roofline,
    measure_scaling,
    measure_throughput,
)
from asca_deploy.benchmark.roofline import SIZE, gemm_rate
from asca_deploy.benchmark.scaling import resample
from asca_deploy.benchmark.throughput import FRAMES
from asca_deploy.benchmark.timing import Percentiles
from asca_deploy.manifest import load_pillar_bundle
from asca_pillars.base.errors import AscaError
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
    monkeypatch.setattr("asca_deploy.benchmark.roofline.perf_counter", lambda: next(clock))  # one second a product
    assert gemm_rate(kind, threads=1, rows=4) == pytest.approx(4 * SIZE * SIZE / 1e9)


def test_roofline(tiny_bundle: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    rates = {"float32": 100.0, "int8": 400.0}
    monkeypatch.setattr("asca_deploy.benchmark.roofline.gemm_rate", lambda kind, threads: rates[kind] * threads)
    bundle = replace(load_pillar_bundle(tiny_bundle), backbone_gmac=5.0)
    found = measure_roofline(bundle, backbone_ms=50.0, threads=2)
    assert found.achieved_gmac_s == pytest.approx(100)
    assert (found.type, found.share) == ("float32", pytest.approx(0.5))
    assert measure_roofline(replace(bundle, precision="int8"), backbone_ms=50.0, threads=2).share == pytest.approx(
        100 / 800
    )


POSE = ((0.0, 1.0, 0.0, 0.5), (-1.0, 0.0, 0.0, 0.0), (0.0, 0.0, 1.0, 0.1), (0.0, 0.0, 0.0, 1.0))


@pytest.mark.parametrize("mounting", [Mounting(1.6, axes="-y,x,z"), Mounting(pose=POSE)])
def test_new_processes_have_the_mounting_of_the_detector(
    tiny_bundle: Path, scan: Points, mounting: Mounting, monkeypatch: pytest.MonkeyPatch
) -> None:
    seen: list[Mounting] = []
    run = cold._run

    def spy(code: str, *arguments: object) -> str:
        if code == cold._DETECT:
            options = dict(zip(map(str, arguments[3::2]), map(str, arguments[4::2]), strict=True))
            height = float(options["--sensor-height"]) if "--sensor-height" in options else None
            pose = read_pose(options["--pose"]) if "--pose" in options else None
            seen.append(Mounting(height, options.get("--axes", "x-forward"), pose))
        else:
            seen.append(Mounting(**json.loads(str(arguments[-1]))))
        return run(code, *arguments)

    monkeypatch.setattr(cold, "_run", spy)
    found = cold_start(Detector(tiny_bundle, threads=1, mounting=mounting), scan, repeats=1)
    assert seen == [mounting, mounting]
    assert found.first_boxes_s >= found.import_s + found.load_s + found.first_scan_s
    assert min(found.import_s, found.load_s, found.first_scan_s) > 0
    assert found.detect_peak_memory_mib is None or 20 < found.detect_peak_memory_mib < 1e5


def test_a_new_process_that_fails_says_why(bundle_copy: Path, scan: Points) -> None:
    detector = Detector(bundle_copy)
    (bundle_copy / "bundle.json").unlink()
    with pytest.raises(AscaError, match="no model bundle"):
        cold_start(detector, scan, repeats=1)


def test_memory_now_and_at_most(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    resident, peak = bench_report.resident_mib(), bench_report.peak_memory_mib()
    assert resident is None or (peak is not None and 10 < resident <= peak + 1)
    monkeypatch.setattr(bench_report, "STATUS", tmp_path / "none")  # a system without /proc
    peak = bench_report.peak_memory_mib()
    assert bench_report.resident_mib() is None and (peak is None or peak > 10)
