"""The first stage as an export copies it: the graphs of a bundle, or a checkpoint in PyTorch."""

import tempfile
from functools import partial
from pathlib import Path
from typing import Any, Literal

import numpy as np
import onnx
from numpy.typing import NDArray

from asca_deploy.bundle import BACKBONE
from asca_deploy.manifest import load_pillar_bundle
from asca_deploy.pillar.pipeline import PillarPipeline, open_backbone
from asca_deploy.shipped import find_bundle
from asca_export.two_stage.neck_output import add_neck_output
from asca_pillars.base.errors import ExportError
from asca_pillars.base.files import WEIGHTS_FILE
from asca_pillars.detection.spec import DetectorSpec
from asca_pillars.models.two_stage.first_stage import open_first_stage
from asca_pillars.ops.two_stage.first_stage import FirstPass, FirstStage, require_pillar_kind


class BundleFirstStage:
    """A bundle in onnxruntime, see `ops.two_stage.first_stage.FirstStage`.

    Args:
        bundle: folder, or name of one that ships.
        threads: of onnxruntime.
        precision: that the bundle must have; the neck's channels of an 8-bit one are scaled, see `add_neck_output`.

    Raises:
        BundleError: the bundle is missing or damaged.
        ConfigError: it is of another kind.
        ExportError: it has another precision.
    """

    def __init__(
        self, bundle: str | Path, *, threads: int = 1, precision: Literal["float32", "int8"] = "float32"
    ) -> None:
        self._source = bundle, threads, precision
        folder = find_bundle(bundle)
        manifest = load_pillar_bundle(folder)
        require_pillar_kind(folder, manifest.kind)
        if manifest.precision != precision:
            raise ExportError(f"{folder}: a bundle in {manifest.precision}; give one in {precision}")
        self._pipeline = PillarPipeline(folder, manifest, threads=threads)
        model = add_neck_output(onnx.load(folder / manifest.graphs[BACKBONE].file))
        with tempfile.TemporaryDirectory() as temporary:
            path = Path(temporary) / manifest.graphs[BACKBONE].file
            onnx.save(model, path)
            channels = model.graph.output[-1].type.tensor_type.shape.dim[-1].dim_value
            self._backbone = open_backbone(path, manifest, "cpu", "float32", threads, channels)
        graphs = " ".join(graph.sha256 for graph in manifest.graphs.values())
        self.identity = manifest.provenance.weights_sha256 or graphs

    @property
    def spec(self) -> DetectorSpec:
        """Of the bundle."""
        return self._pipeline.spec

    def __reduce__(self) -> tuple[Any, ...]:
        """Sent to another process, it is opened there: onnxruntime's sessions cannot be sent."""
        bundle, threads, precision = self._source
        return partial(BundleFirstStage, threads=threads, precision=precision), (bundle,)

    def __call__(self, points: NDArray[np.float32]) -> FirstPass:
        """See `FirstStage`."""
        pillars = self._pipeline.pillarize(points)
        return self._backbone.infer_with_neck(self._backbone.place(self._pipeline.encode(pillars), pillars.cells))


def is_checkpoint(source: str) -> bool:
    """Whether the first stage of that name is a checkpoint, and no bundle."""
    return Path(source).suffix == Path(WEIGHTS_FILE).suffix or Path(source).is_file()


def open_exported(source: str) -> FirstStage:
    """The first stage that a second one was trained on, of a bundle its graphs, which need no weights beside them.

    Raises:
        AscaError: it is missing, damaged, of another family or not in float32.
    """
    return open_first_stage(source) if is_checkpoint(source) else BundleFirstStage(source)
