"""The same network with a dense and with a sparse neck, random weights: what neck and head cost, float and 8 bits.

    python -m benchmarks.sparse_neck [SCANS]...                       # the paper's size

Process time of one thread, onnxruntime on the CPU, forms in alternation, the best round of each. The 8-bit dense
backbone is that of a bundle; tables are what the sparse one needs besides.
"""

import tempfile
import time
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import torch
import typer
from numpy.typing import NDArray

from asca_deploy import sample_scan_path
from asca_deploy.bundle import CanvasFormat
from asca_deploy.ort_session import OrtSession
from asca_deploy.pillar_graphs import PILLAR_FEATURES
from asca_deploy.pillar_pipeline import Canvas
from asca_export import graphs, qdq
from asca_export.fast_forms import FastBackbone
from asca_export.quantize import STEPS, canvas_steps, layer_names, scale_to_steps
from asca_export.sparse_forms import SparseBackbone
from asca_export.sparse_graphs import export_sparse_backbone
from asca_export.sparse_quantize import SparseSample, quantized_backbone
from asca_pillars.data.scans.scan_reader import read_scan
from asca_pillars.evaluation.report import markdown_table
from asca_pillars.geometry.decode import HeadMaps
from asca_pillars.models.pillar.pillar_detector import PillarDetector, build_pillar_detector
from asca_pillars.models.pillar.pillar_preparation import Placement, batch_pillars
from asca_pillars.pillar_config import PillarModel
from asca_pillars.system import cpu_model
from asca_pillars.tables.neck_tables import NeckTableBuilder, table_inputs
from benchmarks.host_path import CAMERA_VIEW
from benchmarks.random_weights import random_weights

FORMS = ("dense float32", "sparse float32", "dense int8", "sparse int8", "tables")


def main(
    scans: Annotated[list[Path] | None, typer.Argument(help="KITTI .bin files; default: the one that ships.")] = None,
    config: Annotated[str, typer.Option(help="YAML, or the name of one that ships.")] = "pointpillars_kitti",
    rounds: Annotated[int, typer.Option(help="Rounds of each form.")] = 5,
) -> None:
    """Print milliseconds for each scan, whole and as the camera sees it."""
    torch.set_num_threads(1)
    loaded = [read_scan(path).points for path in scans or [sample_scan_path()]]
    views = [(f"{index} {view}", part) for index, scan in enumerate(loaded) for view, part in _views(scan)]
    rows = []
    with tempfile.TemporaryDirectory() as work:
        forms = _Forms(config, views[0][1], Path(work))
        for name, points in views:
            steps = forms.of(points)
            times_ms = np.array([[_process_ms(step) for step in steps] for _ in range(rounds)]).min(axis=0)
            gains = times_ms[0] / times_ms[1], times_ms[2] / times_ms[3]
            rows.append((name, *(f"{t:.1f}" for t in times_ms), *(f"{gain:.1f}" for gain in gains)))
    print(f"{cpu_model()}, {config}, process time of one thread in ms, {rounds} rounds\n")
    print(markdown_table(("scan", *FORMS, "gain float32", "gain int8"), rows, left=1))


class _Forms:
    """The graphs, opened once; calibrated on one scan, because nobody trained these weights."""

    def __init__(self, config: str, points: NDArray[np.float32], work: Path) -> None:
        dense = random_weights(config, points)
        model = dense.config.model
        assert isinstance(dense.detector, PillarDetector) and isinstance(model, PillarModel)
        network, self.spec = replace(model.network, neck="sparse"), model.spec
        self.sparse = build_pillar_detector(replace(model, network=network)).eval()
        self.sparse.load_state_dict(dense.detector.state_dict())
        self.tables = NeckTableBuilder(*self.spec.grid.map_shape, network.active_cells)
        sample = self._sample(points)
        self.steps = canvas_steps([sample.features.numpy()])
        channels, grid = network.pillar_channels, self.spec.grid
        form = CanvasFormat("uint8", tuple(int(step) for step in self.steps.empty))
        self.canvases = Canvas(channels, grid), Canvas(channels, grid, form)
        graphs.export_backbone(FastBackbone(dense.detector), grid, work / "dense.onnx")
        rounded = FastBackbone(dense.detector, self.steps).eval()
        canvas = self.canvases[1].scatter(self._whole(sample), self.spec.pillarize(points).cells)
        scale_to_steps(rounded, [canvas], self.steps)
        graphs.export_backbone(rounded, grid, work / "template.onnx")
        qdq.quantize_backbone(work / "template.onnx", work / "dense8.onnx", layer_names(rounded), {})
        export_sparse_backbone(SparseBackbone(self.sparse), work / "sparse.onnx")
        eight_bit = quantized_backbone(self.sparse, [sample], self.steps)
        export_sparse_backbone(eight_bit, work / "sparse8.onnx", list(eight_bit.products), steps=True)
        names = ("dense", "sparse", "dense8", "sparse8")
        self.sessions = [OrtSession(work / f"{name}.onnx", "cpu", "float32", 1) for name in names]

    def of(self, points: NDArray[np.float32]) -> list[Callable[[], Any]]:
        """One frame in each of FORMS."""
        cells, sample = self.spec.pillarize(points).cells, self._sample(points)
        features = sample.features.numpy(), self._whole(sample)
        tables = table_inputs(self.tables.build(cells))
        steps: list[Callable[[], Any]] = []
        for session, feature, canvas in zip(self.sessions, np.repeat([0, 1], 2), np.repeat([0, 1], 2), strict=True):
            if "canvas" in session.inputs:
                inputs = {"canvas": self.canvases[canvas].scatter(features[feature], cells)}
            else:
                given = {PILLAR_FEATURES: features[feature], **tables}
                inputs = {name: given[name] for name in session.inputs}
            steps.append(partial(session.run, HeadMaps._fields, inputs))
        return [*steps, lambda: self.tables.build(cells)]

    def _sample(self, points: NDArray[np.float32]) -> SparseSample:
        pillars = self.spec.pillarize(points)
        batch = batch_pillars([pillars], [Placement(None, self.tables.build(pillars.cells))])
        assert batch.neck is not None
        with torch.inference_mode():
            features = self.sparse.encode(batch.features, batch.pillar_index, batch.point_counts)
        return SparseSample(features.clone(), batch.neck)

    def _whole(self, sample: SparseSample) -> NDArray[np.uint8]:
        return (sample.features / self.steps.scale + self.steps.empty).round().clamp(0, STEPS).numpy().astype(np.uint8)


def _views(scan: NDArray[np.float32]) -> list[tuple[str, NDArray[np.float32]]]:
    in_view = (np.abs(scan[:, 1:3]) <= scan[:, :1] * np.array(CAMERA_VIEW, np.float32)).all(axis=1)
    return [("camera", scan[in_view]), ("whole", scan)]


def _process_ms(step: Callable[[], Any]) -> float:
    start = time.process_time()
    step()
    return (time.process_time() - start) * 1e3


if __name__ == "__main__":
    typer.run(main)
