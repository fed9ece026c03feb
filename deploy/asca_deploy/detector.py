"""From a scan to boxes without PyTorch: the seven stops of the paper, run by NumPy and ONNX Runtime."""

import logging
import time
from collections.abc import Generator, Iterable
from pathlib import Path
from typing import Any, NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from asca_deploy import auto, providers
from asca_deploy.bundle import Bundle, find_bundle, load_bundle, sample_scan_path
from asca_deploy.canvas import Canvas
from asca_deploy.frame import FrameReport, Stopwatch
from asca_deploy.graph import Graph, Tensor
from asca_deploy.input_check import check_input
from asca_deploy.ort_session import OrtSession, check_onnxruntime
from asca_deploy.stream import overlapped
from asca_pillars.data.scans.scan_reader import read_scan
from asca_pillars.errors import ConfigError, ScanError
from asca_pillars.geometry.decode import HeadMaps
from asca_pillars.geometry.detections import Detections
from asca_pillars.geometry.kernels import load_kernels
from asca_pillars.pillars.pillarize import FEATURES, PillarCounts, Pillars
from asca_pillars.system import default_threads

Maps: TypeAlias = HeadMaps[NDArray[np.float32]]

_log = logging.getLogger("asca_deploy")


class _Frame(NamedTuple):
    """A scan between its points and its boxes."""

    watch: Stopwatch
    image: NDArray[Any]
    counts: PillarCounts
    non_finite: int
    warnings: tuple[str, ...]


class Detector:
    """ASCA-PointPillars without PyTorch. One object serves one stream of scans, from one thread at a time.

    Args:
        bundle: folder written by `asca export`, or name of one that ships (`shipped_bundles`); None for the 8-bit one
            that ships.
        provider: of the backbone: "cpu", "cuda", "tensorrt", "openvino", or "auto" for the fastest one at hand that
            finds in the sample scan what "cpu" finds. `self.provider` and `self.precision` say what runs,
            `self.candidates` how each one did. The encoder always runs on onnxruntime's CPU provider.
        precision: "float32", in which the bundle was proven, or "reduced" where the provider has something faster
            (`asca_deploy.providers`); None for float32, with "auto" for either.
        threads: of the CPU; None for the physical cores granted to the process.
        score_threshold: overrides that of every class; None keeps the bundle's.

    Raises:
        BundleError: the bundle is missing, damaged or made for another version.
        ProviderError: the provider is not installed, does not start or lacks the precision; onnxruntime is too old.
        ConfigError: `threads` or `score_threshold` is out of range.
    """

    def __init__(
        self,
        bundle: str | Path | None = None,
        *,
        provider: str = "cpu",
        precision: str | None = None,
        threads: int | None = None,
        score_threshold: float | None = None,
    ) -> None:
        start = time.perf_counter()
        load_kernels()  # here rather than in the first scan
        self.folder = find_bundle(bundle)
        self.threads = default_threads() if threads is None else threads
        if self.threads < 1:
            raise ConfigError(f"threads {self.threads} must be at least 1")
        check_onnxruntime()
        providers.require(provider, precision or "float32")
        self.bundle = load_bundle(self.folder)
        spec = self.bundle.spec
        self.spec = spec if score_threshold is None else spec.with_score_threshold(score_threshold)
        self._encoder = _open_encoder(self.folder, self.bundle)
        self._canvas = self._new_canvas()
        choice = self._choose(provider, precision)
        self._backbone, self.provider, self.precision, self.candidates = choice
        self._warned: set[str] = set()
        self.load_s = time.perf_counter() - start
        self.last_frame: FrameReport | None = None
        """Report of the latest scan; None before the first."""

    def __call__(self, points: NDArray[Any]) -> Detections:
        """Detect objects in one scan.

        Args:
            points: (N, 4) x, y, z in metres (LiDAR frame: x forward, y left, z up) and reflectance 0..1;
                any real type, N may be 0. Points with a NaN or infinite value are dropped and counted.

        Returns:
            Boxes, best first; `self.last_frame` holds times, counters and warnings.

        Raises:
            ScanError: `points` has another shape or is not numeric.
        """
        frame = self._prepare(points, self._canvas)
        return self._finish(frame, self._infer(frame))

    def stream(self, scans: Iterable[NDArray[Any]]) -> Generator[Detections, None, None]:
        """Detections of scan after scan, in order, the same as one by one and more of them per second.

        While the network works on one scan, the next is read and prepared and the one before is decoded, in threads
        that live as long as the iterator; see `asca_deploy.stream`. `last_frame` is that of the scan just yielded.

        Args:
            scans: each as for a call; read in another thread, at most one ahead of the one asked for.

        Raises:
            ScanError: a scan cannot be used; the scans before it have been yielded. Errors of `scans` itself come in
                the same way. Either ends the stream and leaves the detector usable.
        """
        canvases = self._new_canvas(), self._new_canvas()  # not the detector's own: it may be called meanwhile

        def prepare(points: NDArray[Any], slot: int) -> _Frame:
            return self._prepare(points, canvases[slot])

        def infer(frame: _Frame) -> tuple[_Frame, Maps]:
            frame.watch.waited()
            return frame, self._infer(frame)

        def finish(found: tuple[_Frame, Maps]) -> Detections:
            frame, maps = found
            frame.watch.waited()
            return self._finish(frame, maps)

        return overlapped(scans, prepare, infer, finish)

    def pillarize(self, points: NDArray[np.float32]) -> Pillars:
        """Finite points (N, 4) -> the features of M points in P pillars. Paper section 3.2."""
        return self.spec.pillarize(points)

    def encode(self, pillars: Pillars) -> NDArray[Any]:
        """Features (M, 9) -> pillar features (P, C), in the steps of the canvas. Paper section 3.2."""
        if not len(pillars.cells):
            return np.empty((0, self.bundle.channels), self.bundle.canvas.type)
        (features,) = self._encoder.run(
            features=pillars.features, pillar_index=pillars.pillar_index, point_counts=pillars.point_counts
        )
        return features

    def scatter(self, pillar_features: NDArray[Any], cells: NDArray[np.int64]) -> NDArray[Any]:
        """(P, C) at P cells -> pseudo-image (1, ny + 1, nx + 1, C), valid until the next scatter."""
        return self._canvas.scatter(pillar_features, cells)

    def neck_and_head(self, canvas: NDArray[Any]) -> Maps:
        """Pseudo-image (1, ny + 1, nx + 1, C) -> logits and residuals on the head's map. Paper Table 1."""
        return _head_maps(self._backbone, canvas)

    def decode(self, maps: Maps) -> Detections:
        """Head maps -> boxes above the score threshold that survive the rotated NMS."""
        return self.spec.decode(maps)

    def _new_canvas(self) -> Canvas:
        return Canvas(self.bundle.channels, self.spec.grid, self.bundle.canvas)

    def _prepare(self, points: NDArray[Any], canvas: Canvas) -> _Frame:
        """All that comes before the network; the result is valid until the next one on the same canvas."""
        watch = Stopwatch()
        scan, non_finite = _finite_points(points)
        watch.lap("input")
        pillars = self.pillarize(scan)
        watch.lap("pillarize")
        pillar_features = self.encode(pillars)
        watch.lap("encode")
        image = canvas.scatter(pillar_features, pillars.cells)
        watch.lap("scatter")
        warnings = self._compare_with_training(scan, pillars.stats)
        watch.lap("input")
        return _Frame(watch, image, pillars.stats, non_finite, warnings)

    def _infer(self, frame: _Frame) -> Maps:
        maps = self.neck_and_head(frame.image)
        frame.watch.lap("neck+head")
        return maps

    def _finish(self, frame: _Frame, maps: Maps) -> Detections:
        detections = self.decode(maps)
        watch = frame.watch
        watch.lap("decode")
        self.last_frame = FrameReport(watch.times_ms, watch.waiting_ms, frame.counts, frame.non_finite, frame.warnings)
        return detections

    def _choose(self, provider: str, precision: str | None) -> auto.Choice[Graph]:
        def open_network(name: str, digits: str) -> Graph:
            return _open_backbone(self.folder, self.bundle, name, digits, self.threads)

        if provider != providers.AUTO:
            digits = precision or "float32"
            return auto.Choice(open_network(provider, digits), provider, digits, ())
        spec = self.bundle.spec
        pillars = spec.pillarize(read_scan(sample_scan_path()).points)
        canvas = self.scatter(self.encode(pillars), pillars.cells)
        choice = auto.choose(
            providers.at_hand(), open_network, lambda graph: spec.decode(_head_maps(graph, canvas)), spec, precision
        )
        _log.info(auto.summary(*choice[1:]))
        return choice

    def _compare_with_training(self, scan: NDArray[np.float32], counts: PillarCounts) -> tuple[str, ...]:
        warnings = check_input(scan, counts, self.bundle.expected_input)
        for warning in warnings:
            if warning.about not in self._warned:  # the log says each kind once, every report its own
                self._warned.add(warning.about)
                _log.warning("%s (said once)", warning.text)
        return tuple(warning.text for warning in warnings)


def _finite_points(points: NDArray[Any]) -> tuple[NDArray[np.float32], int]:
    """The finite points as contiguous float32 (N, 4), and how many others there were."""
    try:
        with np.errstate(over="ignore"):  # what float32 cannot hold becomes infinite and is counted
            scan = np.ascontiguousarray(points, np.float32)
    except (TypeError, ValueError):
        raise ScanError("the points are not an array of numbers; give (N, 4): x, y, z, reflectance") from None
    if scan.ndim != 2 or scan.shape[1] != 4:
        advice = "; append a column of reflectances 0..1" if scan.ndim == 2 and scan.shape[1] == 3 else ""
        raise ScanError(f"the points have shape {scan.shape}, not (N, 4): x, y, z, reflectance{advice}")
    finite = np.isfinite(scan)
    if finite.all():
        return scan, 0
    usable = finite.all(axis=1)
    return scan[usable], int(len(scan) - usable.sum())


def _head_maps(backbone: Graph, canvas: NDArray[Any]) -> Maps:
    return HeadMaps(*(np.moveaxis(channels_last[0], -1, 0) for channels_last in backbone.run(canvas=canvas)))


def _open_encoder(folder: Path, bundle: Bundle) -> Graph:
    # One thread: the maximum over a pillar's points is a ScatterND with repeated indices, and onnxruntime's threads
    # race for them: now and then a few features come out too small (onnxruntime issue 18048; seen with 1.31). It is
    # the fastest form all the same, ten times faster than ScatterElements.
    path = folder / bundle.graphs.encoder.file
    inputs = {
        "features": Tensor("float32", (None, len(FEATURES))),
        "pillar_index": Tensor("int64", (None,)),
        "point_counts": Tensor("int64", (None,)),
    }
    outputs = {"pillar_features": Tensor(bundle.canvas.type, (None, bundle.channels))}
    return Graph(path, OrtSession(path, "cpu", "float32", threads=1), inputs, outputs)


def _open_backbone(folder: Path, bundle: Bundle, provider: str, precision: str, threads: int) -> Graph:
    grid, anchors = bundle.spec.grid, bundle.spec.anchors.shape[2]
    path = folder / bundle.graphs.backbone.file
    inputs = {"canvas": Tensor(bundle.canvas.type, (1, grid.ny + 1, grid.nx + 1, bundle.channels))}
    outputs = {
        name: Tensor("float32", (1, *grid.head_shape, channels * anchors))
        for name, channels in (("scores", 1), ("boxes", 7), ("directions", 2))
    }
    return Graph(path, providers.open_session(path, provider, precision, threads), inputs, outputs)
