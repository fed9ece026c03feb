"""Choice of `provider="auto"`: the fastest installed provider whose boxes agree with the CPU's in float32."""

import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from typing import Generic, NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from asca_deploy.graph import first_line
from asca_deploy.providers import Precision, Provider, arithmetic
from asca_pillars.base.errors import ProviderError
from asca_pillars.detection.detections import Detections
from asca_pillars.detection.spec import DetectorSpec
from asca_pillars.geometry.boxes import wrap_angle
from asca_pillars.geometry.overlap import iou_3d

REFERENCE: tuple[Provider, Precision] = ("cpu", "float32")

# How far a box may be from its partner. On 13 scans bfloat16 leaves the boxes of the bundle that ships at an IoU of at
# least 0.86, their scores within 0.005; results that are wrong miss boxes, invent them or turn them round.
MIN_IOU = 0.7  # in 3D, what KITTI asks of a car that counts as found
MAX_SCORE_DIFFERENCE = 0.05  # so near to the threshold a box may also be on one side alone
MAX_YAW_DIFFERENCE_RAD = np.deg2rad(10.0)  # the overlap does not show a heading that points backwards

REDUCED_MUST_GAIN = 1.1  # times as fast as float32; digits are not given away for less, nor for noise
TIMED_RUNS = 3  # after one for warming up and comparing
BUDGET_S = 2.0  # after it no further candidate is opened
SLOW_START = ("tensorrt",)  # compiles kernels for up to minutes

AGREES = "agrees"

Network = TypeVar("Network")


@dataclass(frozen=True)
class Candidate:
    """Result of one provider in one precision."""

    provider: Provider
    precision: Precision
    median_ms: float | None
    """Median time from the points to the boxes, warm; None if it was not timed."""
    outcome: str
    """AGREES, or why it could not be taken."""
    weights: str = "float32"
    """The bundle's own precision, float32 or int8."""

    def __str__(self) -> str:
        time_ms = "" if self.median_ms is None else f" {self.median_ms:.1f} ms"
        return f"{self.provider} {arithmetic(self.weights, self.precision)}{time_ms} {self.outcome}"


class Choice(NamedTuple, Generic[Network]):
    """The network that was chosen, and the results of all candidates."""

    network: Network
    provider: Provider
    precision: Precision
    candidates: tuple[Candidate, ...]


def choose(
    names: Iterable[tuple[Provider, Precision]],
    open_network: Callable[[Provider, Precision], Network],
    detect: Callable[[Network], Detections],
    spec: DetectorSpec,
    precision: Precision | None = None,
    clock: Callable[[], float] = time.perf_counter,
    weights: str = "float32",
) -> Choice[Network]:
    """Open, compare and time candidates in turn; return the fastest that agrees, float32 where it is about as fast.

    Args:
        names: (provider, precision) of the candidates besides REFERENCE, in the order of trials.
        open_network: of a provider and a precision.
        detect: the sample scan's boxes by a network.
        spec: whose thresholds those boxes had to reach.
        precision: the only one that may be taken; None for any.
        clock: seconds.
        weights: the bundle's own precision, for the report.

    Raises:
        ProviderError: no candidate in the requested precision can be used; the message says why.
        BundleError: the reference cannot run the graph.
    """
    reference = open_network(*REFERENCE)
    expected = detect(reference)
    candidates = [Candidate(*REFERENCE, _median_ms(detect, reference, clock), AGREES, weights)]
    best: tuple[Candidate, Network] | None = (candidates[0], reference)
    if precision not in (None, REFERENCE[1]):
        best = None
    del reference  # a rejected network must not stay in memory
    start = clock()  # where the CPU is slow, the others are what it is asked for
    for name in names:
        if name == REFERENCE or precision not in (None, name[1]):
            continue
        if reason := _skip_reason(name[0], clock() - start):
            candidates.append(Candidate(*name, None, reason, weights))
            continue
        trial = _measure_candidate(name, open_network, detect, expected, spec, clock)
        trial = trial._replace(candidate=replace(trial.candidate, weights=weights))
        candidates.append(trial.candidate)
        if trial.network is not None and (best is None or _cost(trial.candidate) < _cost(best[0])):
            best = trial.candidate, trial.network
    if best is None:
        seen = "; ".join(map(str, candidates[1:])) or "none is installed, `asca doctor` says what to install"
        raise ProviderError(f"provider auto finds nothing to run in precision {precision}: {seen}")
    return Choice(best[1], best[0].provider, best[0].precision, tuple(candidates))


def summary(runs_on: str, candidates: Iterable[Candidate]) -> str:
    """Return one line on what was chosen (`Detector.runs_on`) and why."""
    return f"auto takes {runs_on}: {'; '.join(map(str, candidates))}"


def disagreement(expected: Detections, actual: Detections, spec: DetectorSpec) -> str | None:
    """Return the first box of either side without a partner on the other; None if every box has one.

    Partners have the same class and are as near as the limits above demand. A box whose score ties with its class's
    threshold needs none. Without any box above its threshold, nothing agrees.
    """
    if not (~_are_score_ties(expected, spec)).any():
        return "unproven, the sample scan shows no clear object with this model"
    for boxes, partners, what in ((expected, actual, "misses"), (actual, expected, "invents")):
        lone = np.flatnonzero(~_have_matches(boxes, partners) & ~_are_score_ties(boxes, spec))
        for index in lone[:1]:
            x_m, y_m = boxes.boxes[index, :2]
            return f"{what} a {boxes.names[index]} of score {boxes.scores[index]:.2f} at x = {x_m:.1f}, y = {y_m:.1f} m"
    return None


class _Trial(NamedTuple, Generic[Network]):
    candidate: Candidate
    network: Network | None
    """None unless it agrees with the reference."""


def _measure_candidate(
    name: tuple[Provider, Precision],
    open_network: Callable[[Provider, Precision], Network],
    detect: Callable[[Network], Detections],
    expected: Detections,
    spec: DetectorSpec,
    clock: Callable[[], float],
) -> _Trial[Network]:
    try:
        network = open_network(*name)
        if differs := disagreement(expected, detect(network), spec):
            return _Trial(Candidate(*name, None, differs), None)
        return _Trial(Candidate(*name, _median_ms(detect, network, clock), AGREES), network)
    except Exception as error:  # onnxruntime's and OpenVINO's share no base class; the candidate is rejected
        return _Trial(Candidate(*name, None, f"does not run: {first_line(error)}"), None)


def _skip_reason(provider: str, elapsed_s: float) -> str | None:
    if provider in SLOW_START:
        return "skipped, it takes up to minutes to start: request it by name"
    return f"not tried, the {BUDGET_S:g} s for trials were over: request it by name" if elapsed_s > BUDGET_S else None


def _median_ms(detect: Callable[[Network], Detections], network: Network, clock: Callable[[], float]) -> float:
    times_s = []
    for _ in range(TIMED_RUNS):
        start = clock()
        detect(network)
        times_s.append(clock() - start)
    return float(np.median(times_s)) * 1e3


def _cost(candidate: Candidate) -> float:
    if candidate.median_ms is None:
        return np.inf
    return candidate.median_ms * (REDUCED_MUST_GAIN if candidate.precision == "reduced" else 1.0)


def _have_matches(boxes: Detections, partners: Detections) -> NDArray[np.bool_]:
    same = boxes.labels[:, None] == partners.labels[None]
    same &= np.abs(boxes.scores[:, None] - partners.scores[None]) <= MAX_SCORE_DIFFERENCE
    same &= np.abs(wrap_angle(boxes.boxes[:, None, 6] - partners.boxes[None, :, 6])) <= MAX_YAW_DIFFERENCE_RAD
    return (same & (iou_3d(boxes.boxes, partners.boxes) >= MIN_IOU)).any(axis=1)


def _are_score_ties(boxes: Detections, spec: DetectorSpec) -> NDArray[np.bool_]:
    thresholds = np.array([class_.score_threshold for class_ in spec.classes])
    return boxes.scores - thresholds[boxes.labels] <= MAX_SCORE_DIFFERENCE
