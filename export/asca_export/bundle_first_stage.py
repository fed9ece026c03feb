"""A bundle as the first stage of two."""

import tempfile
from pathlib import Path

import numpy as np
import onnx
from numpy.typing import NDArray

from asca_deploy import Detector
from asca_deploy.ort_session import OrtSession
from asca_export.neck_output import NECK, add_neck_output
from asca_pillars.geometry.decode import HeadMaps
from asca_pillars.pillars.spec import DetectorSpec
from asca_pillars.second_stage.first_stage import FirstPass


class BundleFirstStage:
    """A float32 bundle in onnxruntime, see `second_stage.first_stage.FirstStage`.

    Args:
        bundle: folder, or name of one that ships.
        threads: of onnxruntime.

    Raises:
        BundleError: the bundle is missing or damaged.
        ExportError: it is not in float32.
    """

    def __init__(self, bundle: str | Path, *, threads: int = 1) -> None:
        self._detector = Detector(bundle, threads=threads)
        graphs = self._detector.bundle.graphs
        model = add_neck_output(onnx.load(self._detector.folder / graphs.backbone.file))
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / graphs.backbone.file
            onnx.save(model, path)
            self._backbone = OrtSession(path, "cpu", "float32", threads)
        self.identity = f"{graphs.encoder.sha256} {graphs.backbone.sha256}"

    @property
    def spec(self) -> DetectorSpec:
        """Of the bundle."""
        return self._detector.spec

    def __call__(self, points: NDArray[np.float32]) -> FirstPass:
        """See `FirstStage`."""
        pillars = self._detector.pillarize(points)
        canvas = self._detector.scatter(self._detector.encode(pillars), pillars.cells)
        *maps, neck = self._backbone.run({"canvas": canvas}, [*HeadMaps._fields, NECK])
        return FirstPass(HeadMaps(*(np.moveaxis(values[0], -1, 0) for values in maps)), neck[0])
