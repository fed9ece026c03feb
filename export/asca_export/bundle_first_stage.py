"""A bundle as the first stage of two."""

import tempfile
from pathlib import Path

import numpy as np
import onnx
from numpy.typing import NDArray

from asca_deploy import providers
from asca_deploy.bundle import BACKBONE, NECK
from asca_deploy.manifest import load_bundle
from asca_deploy.pillar_pipeline import Canvas, PillarPipeline
from asca_deploy.shipped import find_bundle
from asca_export.neck_output import add_neck_output
from asca_pillars.geometry.decode import HeadMaps
from asca_pillars.geometry.detector_spec import DetectorSpec
from asca_pillars.points.first_stage import FirstPass, require_dense_map


class BundleFirstStage:
    """A float32 bundle in onnxruntime, see `points.first_stage.FirstStage`.

    Args:
        bundle: folder, or name of one that ships.
        threads: of onnxruntime.

    Raises:
        BundleError: the bundle is missing or damaged.
        ConfigError: it is of another kind, its neck is sparse, or its map is pooled.
        ExportError: it is not in float32.
    """

    def __init__(self, bundle: str | Path, *, threads: int = 1) -> None:
        folder = find_bundle(bundle)
        manifest = load_bundle(folder)
        require_dense_map(folder, manifest.kind, manifest.pillar.neck, pooled=manifest.spec.grid.pools)
        self._pipeline = PillarPipeline(folder, manifest, threads=threads)
        self._canvas = Canvas(manifest.pillar.channels, manifest.spec.grid, manifest.pillar.canvas)
        model = add_neck_output(onnx.load(folder / manifest.graphs[BACKBONE].file))
        with tempfile.TemporaryDirectory() as temporary:
            path = Path(temporary) / manifest.graphs[BACKBONE].file
            onnx.save(model, path)
            self._backbone = providers.open_session(path, "cpu", "float32", threads)
        self.identity = " ".join(graph.sha256 for graph in manifest.graphs.values())

    @property
    def spec(self) -> DetectorSpec:
        """Of the bundle."""
        return self._pipeline.spec

    def __call__(self, points: NDArray[np.float32]) -> FirstPass:
        """See `FirstStage`."""
        pillars = self._pipeline.pillarize(points)
        image = self._canvas.scatter(self._pipeline.encode(pillars), pillars.cells)
        *maps, neck = self._backbone.run((*HeadMaps._fields, NECK), {"canvas": image})
        return FirstPass(HeadMaps(*(np.moveaxis(values[0], -1, 0) for values in maps)), neck[0])
