"""Detector without PyTorch, with the steps around the pipeline that all detector families share.

A bundle's family decides which pipeline is opened.
"""

import logging
import weakref
from collections.abc import Callable, Generator, Iterable, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import fields, replace
from functools import partial
from pathlib import Path
from time import perf_counter
from typing import Any, Literal, NamedTuple, TypeAlias, get_args

import numpy as np
from numpy.typing import NDArray

from asca_deploy import auto, providers
from asca_deploy.around import about_ground, merge, ranges_around, turns_around, widen_ranges, without_own_vehicle
from asca_deploy.bundle import Bundle, PillarBundle, PvRcnnBundle, weights_digest
from asca_deploy.manifest import load_bundle
from asca_deploy.ort_session import check_onnxruntime
from asca_deploy.pillar.pipeline import PillarPipeline
from asca_deploy.pipeline import Pipeline, StageTimes
from asca_deploy.pv_rcnn.pipeline import PvRcnnPipeline
from asca_deploy.scan_detections import ScanDetections
from asca_deploy.shipped import find_bundle, sample_scan_path
from asca_deploy.stream import overlap_stages
from asca_deploy.two_stage.pipeline import RefinePipeline
from asca_pillars.base.errors import ConfigError, ScanError
from asca_pillars.base.kernels import load_kernels
from asca_pillars.base.system import check_threads, own_version
from asca_pillars.detection import decode
from asca_pillars.detection.detections import Detections, FrameReport, ScanCounts, sum_counts
from asca_pillars.geometry.frame_change import FrameChange
from asca_pillars.scans.input_check import InputWarning, check_input
from asca_pillars.scans.mounting import Mounting
from asca_pillars.scans.scan_reader import read_scan


def open_pipeline(
    folder: Path,
    bundle: Bundle,
    provider: providers.Provider | Literal["auto"],
    precision: providers.Precision | None,
    threads: int,
) -> auto.Choice[Pipeline[Any, Any]]:
    """Open the pipeline of a bundle's family on a provider or, with auto, on the fastest that agrees.

    Args:
        folder: of the bundle.
        bundle: its manifest, verified by `load_bundle`.
        provider, threads: of the slowest network.
        precision: None for float32, with auto for any.

    Raises:
        BundleError: a graph cannot be run or does not match the manifest.
        ProviderError: the provider does not start or cannot run the graph; with auto, none can be taken.
    """

    def open_on(name: providers.Provider, digits: providers.Precision) -> Pipeline[Any, Any]:
        if isinstance(bundle, PvRcnnBundle):
            return PvRcnnPipeline(folder, bundle, name, digits, threads)
        assert isinstance(bundle, PillarBundle), "there are no other kinds"
        family = PillarPipeline if bundle.kind == "pillar" else RefinePipeline
        return family(folder, bundle, name, digits, threads)

    if provider != providers.AUTO:
        digits = precision or "float32"
        return auto.Choice(open_on(provider, digits), provider, digits, ())
    points = read_scan(sample_scan_path()).points

    def detect(pipeline: Pipeline[Any, Any]) -> Detections:
        stage_times: StageTimes = []
        return pipeline.finish(pipeline.infer(pipeline.prepare(points, stage_times), stage_times), stage_times)

    return auto.choose(providers.available(), open_on, detect, bundle.spec, precision, weights=bundle.precision)


_log = logging.getLogger("asca_pillars")


View: TypeAlias = Literal["ahead", "around"]
_WAITING = "waiting"  # in addition to the names of stages
_GIVE = "give (N, 4) real numbers: x, y, z, reflectance"


class UsablePoints(NamedTuple):
    """Points for a pipeline, and how many were dropped or clipped."""

    points: NDArray[np.float32]
    """(N, 4), finite, reflectance within 0..1."""
    unclipped: NDArray[np.float32]
    """(N, 4), the same with the reflectance as it came."""
    non_finite: int
    clipped: int


class _Frame(NamedTuple):
    """State of a scan between its points and its boxes."""

    start: float
    stage_times: StageTimes
    usable: UsablePoints
    """Points in the model's frame."""
    turns: tuple[FrameChange, ...]
    """Turn of each pass."""
    counts: list[ScanCounts]
    """Counts of each pass prepared so far."""
    warnings: list[InputWarning]
    source: Any
    """The points as the caller gave them."""


class Detector:
    """A detector of any kind that ships or was exported, without PyTorch.

    A detector is thread-safe: it keeps no state of a scan, and each call returns the same boxes as alone. Each calling
    thread needs a pseudo-image of its own (`PillarPipeline`) and no lock; calls share the network's threads, so several
    callers get more scans per second only where one leaves cores idle.

    Args:
        bundle: folder written by `asca export`, or name of one that ships (`shipped_bundles`); None for the
            default, see `default_bundle_path`.
        provider: of the slowest network: "cpu", "cuda", "tensorrt", "openvino", or "auto" for the fastest one available
            whose boxes in the sample scan agree with those of "cpu". `self.provider` and `self.precision` are the
            choice, `self.candidates` the results. The other graphs always run on onnxruntime's CPU provider.
        precision: "float32", in which the bundle was proven, or "reduced" where the provider has something faster
            (`asca_deploy.providers`); None for float32, with "auto" for either.
        threads: of the CPU; None for the physical cores granted to the process.
        score_threshold: overrides that of every class, or of the classes named, such as {"Car": 0.4}; None keeps the
            bundle's.
        mounting: pose of the scans' frame relative to the model's. Points and boxes are in the scans' frame. None: the
            scans are like those of the training.
        view: "ahead", or "around" for every direction: one pass with wider ranges where the model was trained on whole
            revolutions (`asca_deploy.around`), else as many turned passes as its field of view needs, merged.
            `self.passes` is their number; each turned one costs as much as a scan ahead.

    Raises:
        BundleError: the bundle is missing, damaged or made for another version.
        ProviderError: the provider is not installed, does not start or lacks the precision; onnxruntime is too old.
        ConfigError: `threads`, `score_threshold` or `view` is out of range, or `mounting` is none.
    """

    def __init__(
        self,
        bundle: str | Path | None = None,
        *,
        provider: providers.Provider | Literal["auto"] = "cpu",
        precision: providers.Precision | None = None,
        threads: int | None = None,
        score_threshold: float | Mapping[str, float] | None = None,
        mounting: Mounting | None = None,
        view: View = "ahead",
    ) -> None:
        start = perf_counter()
        load_kernels(decode.KERNELS)  # not during the first scan
        self.folder = find_bundle(bundle)
        self.threads = check_threads(threads)
        check_onnxruntime()
        providers.require(provider, precision or "float32")
        if view not in get_args(View):
            raise ConfigError(f"view {view}: give {' or '.join(get_args(View))}")
        manifest = load_bundle(self.folder)
        self.bundle: Bundle = widen_ranges(manifest) if view == "around" else manifest
        spec = self.bundle.spec
        self.spec = spec if score_threshold is None else spec.with_score_threshold(score_threshold)
        self.pipeline, self.provider, self.precision, self.candidates = open_pipeline(
            self.folder, self.bundle, provider, precision, self.threads
        )
        self.pipeline.spec = self.spec
        if self.candidates:
            _log.info(auto.summary(self.runs_on, self.candidates))
        if not isinstance(mounting, Mounting | None):
            raise ConfigError(f"mounting {mounting!r:.40}: give Mounting(...), such as Mounting(sensor_height_m=1.8)")
        expected = self.bundle.expected_input
        self.view, self.mounting = view, mounting or Mounting()
        self._to_model = self.mounting.to_model(expected.sensor_height_m)
        self._level = None if self.mounting.level.is_identity else self.mounting.level
        self._turns: tuple[FrameChange, ...] = (FrameChange.turn(0.0),)
        if view == "around":
            self._turns = turns_around(self.spec.ranges, camera_view=expected.camera_view)
        self._ranges = ranges_around(self.spec.ranges, self.passes)
        self._warned: set[str] = set()
        self._executor = ThreadPoolExecutor(1) if self.threads > 1 else None
        self.made_by = {
            "model": self.bundle.name,
            "weights_sha256": weights_digest(self.bundle),
            "version": own_version(),
        }
        """Origin of its results: the model, the SHA-256 of its weights, and the version of this package."""
        self.load_s = perf_counter() - start
        """Seconds that it took to open the bundle."""

    @property
    def runs_on(self) -> str:
        """Provider and arithmetic of the slowest network in words, such as "cpu int8"."""
        return f"{self.provider} {providers.arithmetic(self.bundle.precision, self.precision)}"

    def warm_up(self, points: int = 100_000, scans: int = 2) -> float:
        """Detect in made-up scans, so that the first real one takes no longer than the others.

        Compiles kernels that are not compiled yet, and lets the runtime allocate memory for scans of this size. Logs
        and warns of nothing.

        Args:
            points: of each scan.
            scans: how many.

        Returns:
            Milliseconds of the last one.
        """
        bounds = np.array([self.spec.ranges.x_m, self.spec.ranges.y_m, self.spec.ranges.z_m])
        drawn = np.random.default_rng(0).random((points, 4), np.float32)
        drawn[:, :3] = bounds[:, 0] + drawn[:, :3] * (bounds[:, 1] - bounds[:, 0])
        took_ms = 0.0
        for _ in range(scans):
            start, stage_times = perf_counter(), [("input", perf_counter())]
            for turn in self._turns:
                prepared = self.pipeline.prepare(turn.points(drawn), stage_times)
                self.pipeline.finish(self.pipeline.infer(prepared, stage_times), stage_times)
            took_ms = (perf_counter() - start) * 1e3
        return took_ms

    @property
    def passes(self) -> int:
        """Number of passes of the network per scan: 1, or as many as `view="around"` needs."""
        return len(self._turns)

    def __call__(self, points: NDArray[Any]) -> ScanDetections:
        """Detect objects in one scan.

        Args:
            points: (N, 4) x, y, z in metres (x forward, y left, z up, or as the mounting says) and reflectance 0..1;
                any real type, N may be 0. Points with a NaN or infinite value are dropped, reflectances outside 0..1
                are set to the nearer end; the report counts both.

        Returns:
            Boxes, best first; their `report` holds times, counters and warnings. They keep a weak reference to
            `points`, which costs no memory, so that they can be drawn as long as the caller keeps the points.

        Raises:
            ScanError: `points` has another shape or does not hold real numbers.
            BundleError: a graph fails while it runs; on other hardware than the CPU a ProviderError.
        """
        frame = self._open(points)
        # Pass by pass, so that all of them need no more than one pseudo-image.
        raw = [self.pipeline.infer(self._prepare(frame, turn), frame.stage_times) for turn in frame.turns]
        return self._finish(frame, raw)

    def stream(self, scans: Iterable[NDArray[Any]]) -> Generator[ScanDetections, None, None]:
        """Yield the detections of scan after scan, in order: those of single calls, at a higher rate.

        While the network works on one scan, the next is read and prepared and the one before is decoded, in threads
        that live as long as the iterator; see `asca_deploy.stream`.

        Args:
            scans: (N, 4) each, as for a call; read in another thread, at most one ahead of the one requested.

        Raises:
            ScanError: a scan cannot be used; the scans before it have been yielded. Errors of `scans` itself come in
                the same way. Either ends the stream and leaves the detector usable.
        """

        def prepare(points: NDArray[Any]) -> tuple[_Frame, list[Any]]:
            frame = self._open(points)
            return frame, [self._prepare(frame, turn) for turn in frame.turns]

        def infer(ready: tuple[_Frame, list[Any]]) -> tuple[_Frame, list[Any]]:
            frame, prepared = ready
            frame.stage_times.append((_WAITING, perf_counter()))
            return frame, [self.pipeline.infer(scan, frame.stage_times) for scan in prepared]

        def finish(inferred: tuple[_Frame, list[Any]]) -> ScanDetections:
            frame, raw = inferred
            frame.stage_times.append((_WAITING, perf_counter()))
            return self._finish(frame, raw)

        return overlap_stages(scans, prepare, infer, finish)

    def _open(self, points: NDArray[Any]) -> _Frame:
        """Return the usable points in the model's frame."""
        start = perf_counter()
        usable = usable_points(points, self._to_model)
        warnings = []
        if usable.clipped:
            text = f"{usable.clipped} reflectances lie outside 0..1 and were set to the nearer end"
            warnings.append(InputWarning("clipped", text))
        turns = self._turns if self.passes == 1 else about_ground(self._turns, usable.points)
        return _Frame(start, [("input", perf_counter())], usable, turns, [], warnings, points)

    def _prepare(self, frame: _Frame, turn: FrameChange) -> Any:
        """Prepare one pass for the slowest network; beside the first, check the scan against the expected input."""
        points = frame.usable.points if turn.is_identity else turn.points(frame.usable.points)
        frame.stage_times.append(("input", perf_counter()))
        checked = None if frame.counts else self._check(frame.usable.unclipped)
        prepared = self.pipeline.prepare(points, frame.stage_times)
        if checked is not None:
            frame.warnings[:0] = checked()
            frame.stage_times.append(("input", perf_counter()))
        frame.counts.append(prepared.counts)
        return prepared

    def _check(self, points: NDArray[np.float32]) -> Callable[[], list[InputWarning]]:
        """Return what gives the scan's warnings; with two threads or more, another core finds them meanwhile."""
        expected, around = self.bundle.expected_input, self.view == "around"
        check = partial(check_input, points, self._ranges, expected, self.mounting, around=around)
        return self._executor.submit(check).result if self._executor else check

    def _finish(self, frame: _Frame, raw: list[Any]) -> ScanDetections:
        passes = [self.pipeline.finish(outputs, frame.stage_times) for outputs in raw]
        if self.view == "around":
            passes = [without_own_vehicle(boxes) for boxes in passes]
        if self.passes == 1:
            detections, counts = passes[0], frame.counts[0]
        else:
            detections, counts = merge(passes, frame.turns, self.spec.post.nms_iou), sum_counts(frame.counts)
        if not self._to_model.is_identity:
            detections = replace(detections, boxes=self._to_model.inverse.boxes(detections.boxes))
        frame.stage_times.append((self.pipeline.stages[-1], perf_counter()))
        if frame.usable.non_finite:
            text = f"{frame.usable.non_finite} points are not finite and were dropped"
            frame.warnings.append(InputWarning("non-finite", text))
        if detections.non_finite:
            text = f"the network's answer is not finite at {detections.non_finite} anchors, which were left out"
            frame.warnings.append(InputWarning("output", text))
        for warning in frame.warnings:
            if warning.about not in self._warned:  # the log says each kind once, every report its own
                self._warned.add(warning.about)
                _log.warning("%s (said once)", warning.text)
        times_ms = dict.fromkeys(("input", *self.pipeline.stages, _WAITING), 0.0)
        last = frame.start
        for name, end in frame.stage_times:
            times_ms[name] += (end - last) * 1e3
            last = end
        report = FrameReport(
            waiting_ms=times_ms.pop(_WAITING),
            times_ms=times_ms,
            counts=counts,
            passes=self.passes,
            non_finite_points=frame.usable.non_finite,
            clipped_reflectances=frame.usable.clipped,
            non_finite_outputs=detections.non_finite,
            warnings=tuple(warning.text for warning in frame.warnings),
        )
        source = weakref.ref(frame.source) if isinstance(frame.source, np.ndarray) else None
        return ScanDetections(
            **{field.name: getattr(detections, field.name) for field in fields(detections)},
            report=report,
            ranges=self._ranges,
            level=self._level,
            source=source,
            made_by=self.made_by,
        )


def usable_points(points: NDArray[Any], to_model: FrameChange | None = None) -> UsablePoints:
    """Return the points of (N, 4) that are finite in the model's frame as contiguous float32, reflectance within 0..1.

    Args:
        points: (N, 4) x, y, z in metres and reflectance, of any real type.
        to_model: into the model's frame; None if they are in it.

    Raises:
        ScanError: `points` has another shape or does not hold real numbers.
    """
    if isinstance(points, np.ma.MaskedArray):
        raise ScanError(
            "the points are a masked array; give those that are not masked: points[~points.mask.any(1)].data"
        )
    try:
        array = np.asarray(points)
    except (TypeError, ValueError, OverflowError):
        raise ScanError(f"the points are not an array of numbers; {_GIVE}") from None
    if array.dtype.kind not in "iuf":
        raise ScanError(f"the points are not an array of numbers, but of type {str(array.dtype)[:40]}; {_GIVE}")
    with np.errstate(over="ignore"):  # values beyond float32 become infinite and are counted
        scan = np.ascontiguousarray(array, np.float32)
    if scan.ndim != 2 or scan.shape[1] != 4:
        columns = scan.shape[1] if scan.ndim == 2 else 0
        advice = "; append a column of reflectances 0..1" if columns == 3 else ""
        advice = "; give the first four columns: points[:, :4]" if columns > 4 else advice
        advice = "; the points lie in its columns, transpose it: points.T" if columns > len(scan) == 4 else advice
        raise ScanError(f"the points have shape {array.shape}, not (N, 4): x, y, z, reflectance{advice}")
    if to_model is not None and not to_model.is_identity:
        scan = to_model.points(scan)
    finite, non_finite = np.isfinite(scan), 0  # in the model's frame: a turn may lead out of float32
    if not finite.all():
        usable = finite.all(axis=1)
        scan, non_finite = scan[usable], int(len(scan) - usable.sum())
    reflectance = scan[:, 3].copy()  # in one piece, which NumPy searches several times faster
    if not len(scan) or (reflectance.min() >= 0 and reflectance.max() <= 1):
        return UsablePoints(scan, scan, non_finite, 0)
    clipped = scan.copy()
    np.clip(reflectance, 0, 1, out=clipped[:, 3])
    return UsablePoints(clipped, scan, non_finite, int((clipped[:, 3] != reflectance).sum()))
