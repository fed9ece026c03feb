import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from asca_deploy import Detector
from asca_deploy.benchmark import bench_report as process_memory
from asca_deploy.benchmark import cold, cold_start, measure_roofline, measure_scaling, measure_throughput
from asca_deploy.benchmark.roofline import SIZE, gemm_rate
from asca_deploy.benchmark.scaling import resample
from asca_deploy.benchmark.throughput import FRAMES
from asca_deploy.manifest import load_pillar_bundle
from asca_pillars.base.errors import AscaError
from asca_pillars.geometry.frame_change import FrameChange
from asca_pillars.ops.pillar.prepare import PillarCounts
from asca_pillars.scans.mounting import Mounting, read_pose
from tests.deploy.conftest import STAGES

Points = NDArray[np.float32]


def test_fewer_points_are_some_of_the_scan(scan: Points) -> None:
    some = resample(scan, 100)
    assert some.shape == (100, 4) and some.dtype == np.float32
    assert len({tuple(point) for point in some.tolist()} - {tuple(point) for point in scan.tolist()}) == 0
    np.testing.assert_array_equal(some, resample(scan, 100))


def test_more_points_are_the_scan_and_noisy_copies(scan: Points) -> None:
    before = scan.copy()
    more = resample(scan, 5000)
    np.testing.assert_array_equal(scan, before)
    assert more.shape == (5000, 4)
    rows = {tuple(point) for point in more.tolist()}
    assert {tuple(point) for point in scan.tolist()} <= rows and len(rows) > 4900
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


def test_throughput_of_stream_and_single_calls(tiny_bundle: Path, scans: list[Points]) -> None:
    found = measure_throughput(Detector(tiny_bundle), scans, rounds=2)
    assert found.single_fps > 0 and found.stream_fps > 0
    assert found.gain.low <= found.gain.median <= found.gain.high
    assert found.single_latency_ms.p50 > 0 and found.stream_latency_ms.p50 > 0


def test_every_streamed_frame_counts_but_the_first(
    tiny_bundle: Path, scan: Points, monkeypatch: pytest.MonkeyPatch
) -> None:
    sizes: list[int] = []
    monkeypatch.setattr(
        "asca_deploy.benchmark.throughput.Percentiles.of", lambda times: sizes.append(len(times)) or None
    )
    measure_throughput(Detector(tiny_bundle), [scan], rounds=3)
    assert sizes == [3 * FRAMES, 3 * FRAMES]


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


def test_a_new_process_finds_boxes_and_says_what_it_took(tiny_bundle: Path, scan: Points) -> None:
    found = cold_start(Detector(tiny_bundle, threads=1), scan, repeats=1)
    assert found.first_boxes_s >= found.import_s + found.load_s + found.first_scan_s
    assert min(found.import_s, found.load_s, found.first_scan_s) > 0
    assert found.detect_peak_memory_mib is None or 20 < found.detect_peak_memory_mib < 1e5


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
    cold_start(Detector(tiny_bundle, threads=1, mounting=mounting), scan, repeats=1)
    assert seen == [mounting, mounting]


def test_a_new_process_that_fails_says_why(bundle_copy: Path, scan: Points) -> None:
    detector = Detector(bundle_copy)
    (bundle_copy / "bundle.json").unlink()
    with pytest.raises(AscaError, match="no model bundle"):
        cold_start(detector, scan, repeats=1)


def test_memory_now_and_at_most() -> None:
    resident, peak = process_memory.resident_mib(), process_memory.peak_memory_mib()
    assert resident is None or (peak is not None and 10 < resident <= peak + 1)


def test_memory_where_there_is_no_proc(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(process_memory, "STATUS", tmp_path / "none")
    assert process_memory.resident_mib() is None
    peak = process_memory.peak_memory_mib()
    assert peak is None or peak > 10
