"""An 8-bit bundle, from the checkpoint to boxes."""

import shutil
from collections import defaultdict
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import onnx
import pytest

from asca_deploy import Detector
from asca_deploy.bundle import PillarBundle
from asca_deploy.manifest import load_pillar_bundle
from asca_export import graphs, int8
from asca_export.bundle_writer import ExportOptions
from asca_export.pillar.export import export_pillar_bundle
from asca_pillars.base.errors import ExportError
from asca_pillars.config.tree import pillar_spec
from asca_pillars.models.pillar.network import PillarDetector
from tests.export.sweeps import remembered
from tests.export.tiny import CALIBRATION, SCANS, tiny_checkpoint

Exports = Callable[[str], Path]


def export_int8(folder: Path) -> PillarBundle:
    checkpoint = tiny_checkpoint("channel")
    spec = pillar_spec(checkpoint.config).with_score_threshold(0.02)  # random weights are never sure of anything
    checkpoint = checkpoint._replace(
        config=replace(checkpoint.config, model=replace(checkpoint.config.model, spec=spec))  # type: ignore[arg-type]
    )
    # Two of the compared scans are given to calibrate on as well.
    return export_pillar_bundle(
        checkpoint, folder, SCANS, ExportOptions(calibration=[*CALIBRATION, SCANS[3], SCANS[0].copy()])
    )


def quantize(folder: Path, copy: Path, calibration: list[np.ndarray]) -> PillarBundle:
    """The second half of such an export, on a copy of a proven float bundle."""
    shutil.copytree(folder, copy)
    detector = tiny_checkpoint("channel").detector
    assert isinstance(detector, PillarDetector)
    return int8.quantize_bundle(copy, load_pillar_bundle(copy), detector, calibration, SCANS)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    made = tmp_path_factory.mktemp("bundles") / "int8"
    export_int8(made)
    return made


def test_the_bundle_says_what_it_is(folder: Path) -> None:
    bundle = load_pillar_bundle(folder)
    assert (bundle.name, bundle.precision, bundle.pillar.canvas.type) == ("tiny", "int8", "uint8")
    assert len(bundle.pillar.canvas.empty) == bundle.pillar.channels
    assert any(bundle.pillar.canvas.empty), "attention makes features negative, so zero is not the lowest step"
    report = bundle.quantization
    assert report is not None and bundle.parity is not None
    assert (report.calibration_scans, report.dropped_scans, report.compared_scans) == (8, 2, 8)
    assert len(report.layers) == 6 + 3 + 1 and not any(layer.kept_float for layer in report.layers)
    assert 0 < report.logit_rms_error <= int8.MAX_LOGIT_ERROR
    assert report.boxes > 20 and report.boxes_matched > 0.9 * report.boxes
    properties = [item.key for item in onnx.load(folder / "backbone.onnx").metadata_props]
    assert {"spec", "pillar", "license"} <= set(properties)


def test_an_empty_scan_and_a_frame_that_inherits_nothing(folder: Path) -> None:
    detector = Detector(folder)
    first = detector(SCANS[0])
    detector(SCANS[1])
    detector(np.empty((0, 4), np.float32))
    again = detector(SCANS[0])
    assert np.array_equal(first.boxes, again.boxes) and len(first) > 2


def test_layers_that_hurt_stay_in_floating_point(
    folder: Path, exported: Exports, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    whole = load_pillar_bundle(folder).quantization
    assert whole is not None
    monkeypatch.setattr(int8, "MAX_LOGIT_ERROR", 0.8 * whole.logit_rms_error)
    monkeypatch.setattr(int8, "sweep", remembered({layer.layer: layer.logit_rms_error for layer in whole.layers}))
    bundle = quantize(exported("channel"), tmp_path / "bundle", CALIBRATION)
    report = bundle.quantization
    assert report is not None and report.logit_rms_error <= 0.8 * whole.logit_rms_error
    kept = [layer for layer in report.layers if layer.kept_float]
    assert kept and max(layer.logit_rms_error for layer in kept) <= min(
        layer.logit_rms_error for layer in report.layers if not layer.kept_float
    )
    # The runtime must not turn them into 8-bit ones behind our back.
    detector = Detector(tmp_path / "bundle", score_threshold=0.02)
    assert len(detector(SCANS[0])) > 2


def test_scans_that_cannot_calibrate(exported: Exports, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    nothing = np.full((5, 4), 500.0, np.float32)  # nowhere on the grid
    with pytest.raises(ExportError, match="7 scans with points on the grid given to calibrate on"):
        quantize(exported("channel"), tmp_path / "a", [*CALIBRATION[:7], nothing])
    monkeypatch.setattr(int8, "MAX_LOGIT_ERROR", 0.0)
    monkeypatch.setattr(int8, "sweep", remembered(defaultdict(lambda: 1.0)))
    with pytest.raises(ExportError, match="an 8-bit canvas alone moves the class logits"):
        quantize(exported("channel"), tmp_path / "b", CALIBRATION)


def test_calibration_on_the_compared_scans_alone_is_refused_before_the_work(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(graphs, "export_encoder", lambda *_: pytest.fail("exported"))
    with pytest.raises(ExportError, match=r"8 were left out because parity is proven on them.*other scans to --calib"):
        export_pillar_bundle(tiny_checkpoint("channel"), tmp_path / "bundle", SCANS, ExportOptions(calibration=SCANS))
    assert not list(tmp_path.iterdir())
