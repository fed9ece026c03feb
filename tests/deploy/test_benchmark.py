import json
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from asca_deploy import Detector
from asca_deploy.benchmark import benchmark
from tests.deploy.conftest import STAGES


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


def test_report_as_json(tiny_bundle: Path, scan: NDArray[np.float32]) -> None:
    report = json.loads(json.dumps(benchmark(Detector(tiny_bundle), [scan], rounds=2).to_dict()))
    assert report["fps"] > 0
    assert set(report["total_ms"]) == {"p50", "p95", "p99", "min", "max"}
    assert set(report["stages_ms"]["decode"]) == {"p50", "p95", "p99", "min", "max"}
    assert {"provider", "threads", "cpu"} <= set(report)
    assert report["versions"]["onnxruntime"]


def test_the_input_hash_tells_scans_apart(tiny_bundle: Path, scans: list[NDArray[np.float32]]) -> None:
    hashes = [benchmark(Detector(tiny_bundle), [s], rounds=1, warmup=0).input_sha256 for s in (*scans, scans[0])]
    assert len(set(hashes)) == 3
    assert hashes[0] == hashes[3]


@pytest.mark.parametrize(("count", "rounds"), [(0, 3), (1, 0)])
def test_nothing_to_measure(tiny_bundle: Path, scans: list[NDArray[np.float32]], count: int, rounds: int) -> None:
    with pytest.raises(ValueError, match="at least one of each"):
        benchmark(Detector(tiny_bundle), scans[:count], rounds=rounds)
