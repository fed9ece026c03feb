"""A sparse neck from the checkpoint to boxes: bundles in float and in 8 bits, threads, streams, providers, reports."""

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from asca_deploy import Detector
from asca_deploy.benchmark import benchmark
from asca_deploy.golden import golden_stages
from asca_deploy.manifest import load_pillar_bundle
from asca_deploy.pillar.pipeline import PillarPipeline, open_backbone
from asca_export.bundle_writer import ExportOptions
from asca_export.pillar.export import export_pillar_bundle
from asca_pillars.base.errors import ProviderError
from tests.export.tiny import CALIBRATION, NOTHING, ONE_POINT, SCANS, sparse_checkpoint
from tests.helpers.same_detections import same

STAGES = ("pillarize", "encode", "rulebooks", "neck+head", "decode")


@pytest.fixture(scope="module")
def int8_bundle(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("bundles") / "int8"
    export_pillar_bundle(sparse_checkpoint("fine"), folder, SCANS, ExportOptions(calibration=CALIBRATION))
    return folder


@pytest.mark.parametrize("rule", ["sub", "fine"])
def test_golden_vectors_hold_the_tables(exported: Callable[[str], Path], rule: str) -> None:
    detector = Detector(exported(rule), threads=1)
    assert isinstance(detector.pipeline, PillarPipeline)
    stages = golden_stages(detector.pipeline, SCANS[0])
    assert {"pillar_features", "strided_0", "same_2", "places_1"} < set(stages["rulebooks"])
    head = stages["neck+head"]
    assert len(head["scores"]) == len(head["cells"]) == len(stages["rulebooks"]["places_0"])
    np.testing.assert_array_equal(stages["suppress"]["boxes"], detector(SCANS[0]).boxes)


def test_eight_bits_report_how_near_they_are(int8_bundle: Path) -> None:
    bundle = load_pillar_bundle(int8_bundle)
    assert (bundle.name, bundle.precision, bundle.pillar.canvas.type) == ("tiny", "int8", "uint8")
    report = bundle.quantization
    assert report is not None and len(report.layers) == 6 + 3 + 1
    assert 0 < report.logit_rms_error <= 0.08 and not any(layer.kept_float for layer in report.layers)
    assert report.boxes > 20 and report.boxes_matched > 0.9 * report.boxes
    detector = Detector(int8_bundle)
    assert len(detector(NOTHING)) == 0
    assert np.isfinite(detector(ONE_POINT).boxes).all()


def test_threads_within_and_without_and_a_stream_find_the_same_boxes(int8_bundle: Path) -> None:
    detector, scans = Detector(int8_bundle), [*SCANS, NOTHING, ONE_POINT]
    alone = [detector(points) for points in scans]
    assert sum(map(len, alone)) > 20
    with ThreadPoolExecutor(8) as threads:
        together = list(threads.map(detector, scans * 6))
    assert all(same(found, expected) for found, expected in zip(together, alone * 6, strict=True))
    assert all(same(found, expected) for found, expected in zip(detector.stream(scans), alone, strict=True))
    for several in (Detector(int8_bundle, threads=1), Detector(int8_bundle, threads=3)):
        assert all(same(several(points), expected) for points, expected in zip(SCANS, alone, strict=False))


def test_reports_name_the_stages_of_this_pipeline(int8_bundle: Path) -> None:
    detector = Detector(int8_bundle)
    assert tuple(detector(SCANS[0]).report.times_ms) == ("input", *STAGES)
    assert tuple(benchmark(detector, SCANS[:2], rounds=2, warmup=1).stages_ms) == ("input", *STAGES)


@pytest.mark.parametrize("provider", ["openvino", "tensorrt"])
def test_a_provider_that_cannot_run_it_says_why(int8_bundle: Path, provider: Any) -> None:
    bundle = load_pillar_bundle(int8_bundle)
    with pytest.raises(ProviderError, match=f"{provider} cannot run the sparse neck of tiny: .*provider cpu"):
        open_backbone(int8_bundle / "backbone.onnx", bundle, provider, "float32", 1)


def test_auto_leaves_out_what_cannot_run_it(int8_bundle: Path) -> None:
    detector = Detector(int8_bundle, provider="auto")
    assert detector.provider == "cpu"
    assert all("fixed shapes" in str(each) for each in detector.candidates if each.provider == "openvino")
