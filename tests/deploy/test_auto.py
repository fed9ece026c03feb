import logging
import re
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
from numpy.typing import NDArray

from asca_deploy import Detector, auto
from asca_deploy.providers import PRECISIONS, PROVIDERS, Precision, Provider
from asca_pillars.base.errors import BundleError, ProviderError
from asca_pillars.detection.anchors import KITTI_CLASSES
from asca_pillars.detection.detections import Detections
from asca_pillars.ops.pillar.spec import PillarSpec
from tests.deploy.conftest import SPEC

BOXES = np.array(
    [
        [10.0, 2.0, -1.0, 3.9, 1.6, 1.5, 0.1],
        [30.0, -8.0, -1.0, 4.2, 1.7, 1.6, 3.1],
        [12.0, 5.0, -0.6, 0.8, 0.6, 1.7, -1.0],
    ],
    np.float32,
)
THRESHOLD = 0.3
THRESHOLDS: PillarSpec = replace(
    SPEC, classes=tuple(replace(class_, score_threshold=THRESHOLD) for class_ in KITTI_CLASSES)
)
FOUND = Detections(
    BOXES, np.array([0.9, 0.6, 0.5], np.float32), np.array([0, 0, 1]), tuple(c.name for c in KITTI_CLASSES)
)


def moved(index: int, column: int, by: float) -> Detections:
    boxes = FOUND.boxes.copy()
    boxes[index, column] += by
    return replace(FOUND, boxes=boxes)


def rescored(index: int, score: float) -> Detections:
    scores = FOUND.scores.copy()
    scores[index] = score
    return replace(FOUND, scores=scores)


def with_a_fourth(score: float) -> Detections:
    extra = BOXES[:1] + np.array([20, 0, 0, 0, 0, 0, 0], np.float32)
    return Detections(
        np.concatenate([BOXES, extra]),
        np.append(FOUND.scores, np.float32(score)),
        np.append(FOUND.labels, 2),
        FOUND.class_names,
    )


@pytest.mark.parametrize(
    "found",
    [
        FOUND,
        FOUND[[2, 0, 1]],
        moved(0, 0, 0.3),  # 3.9 m long: an IoU of 0.86
        moved(1, 6, 2 * np.pi),
        rescored(0, 0.87),
        with_a_fourth(THRESHOLD + 0.04),
    ],
)
def test_agreement(found: Detections) -> None:
    assert auto.disagreement(FOUND, found, THRESHOLDS) is None
    assert auto.disagreement(found, FOUND, THRESHOLDS) is None


@pytest.mark.parametrize(
    ("found", "message"),
    [
        (FOUND[:2], r"misses a Pedestrian of score 0.50 at x = 12.0, y = 5.0 m"),
        (with_a_fourth(0.5), r"invents a Cyclist of score 0.50 at x = 30.0"),
        (moved(1, 0, 1.0), r"misses a Car of score 0.60"),
        (moved(1, 2, 0.5), r"misses a Car"),
        (moved(1, 6, np.pi), r"misses a Car"),
        (rescored(0, 0.8), r"misses a Car of score 0.90"),
        (replace(FOUND, labels=np.array([0, 0, 2])), r"misses a Pedestrian"),
        (Detections.empty(FOUND.class_names), r"misses a Car"),
    ],
)
def test_disagreement(found: Detections, message: str) -> None:
    said = auto.disagreement(FOUND, found, THRESHOLDS)
    assert said is not None
    assert re.match(message, said)


def test_without_a_clear_box_or_a_graph_that_runs_nothing_is_proven() -> None:
    with pytest.raises(BundleError):
        Machine(cpu_float32=(BundleError("damaged"), 0.0)).choose()
    weak = replace(FOUND, scores=np.full(3, THRESHOLD + 0.01, np.float32))
    for nothing in (Detections.empty(FOUND.class_names), weak):
        assert "unproven" in str(auto.disagreement(nothing, nothing, THRESHOLDS))


def way(name: str) -> tuple[Provider, Precision]:
    """cpu_float32 -> its provider and precision."""
    return next((p, q) for p in PROVIDERS for q in PRECISIONS if f"{p}_{q}" == name)


class Machine:
    """Networks of stub providers: what each finds, and how long that takes by a clock of their own."""

    class Network(NamedTuple):
        found: Detections | Exception
        seconds: float

    def __init__(self, **networks: tuple[Detections | Exception, float]) -> None:
        self.networks = {way(name): self.Network(*network) for name, network in networks.items()}
        self.opened: list[tuple[Provider, Precision]] = []
        self.now = 100.0

    def open(self, provider: Provider, precision: Precision) -> Network:
        self.opened.append((provider, precision))
        network = self.networks[provider, precision]
        if isinstance(network.found, ProviderError):
            raise network.found
        return network

    def detect(self, network: Network) -> Detections:
        self.now += network.seconds
        if isinstance(network.found, Exception):
            raise network.found
        return network.found

    def choose(self, precision: Precision | None = None) -> auto.Choice[Network]:
        names = list(self.networks)
        return auto.choose(names, self.open, self.detect, THRESHOLDS, precision, lambda: self.now)


def outcomes(choice: auto.Choice[Machine.Network]) -> dict[str, str]:
    return {f"{item.provider}_{item.precision}": item.outcome for item in choice.candidates}


def test_the_fastest_that_agrees_is_taken() -> None:
    machine = Machine(
        cpu_float32=(FOUND, 0.07),
        cuda_reduced=(FOUND[:2], 0.001),
        cuda_float32=(moved(0, 0, 0.1), 0.003),
        tensorrt_reduced=(FOUND, 0.002),
        openvino_reduced=(FOUND, 0.03),
        openvino_float32=(ProviderError("no AVX\nand more"), 0.0),
    )
    choice = machine.choose()
    assert (choice.provider, choice.precision) == ("cuda", "float32")
    assert choice.network is machine.networks["cuda", "float32"]
    times_ms = {f"{item.provider}_{item.precision}": item.median_ms for item in choice.candidates}
    assert times_ms["cuda_float32"] == pytest.approx(3) and times_ms["cpu_float32"] == pytest.approx(70)
    found = outcomes(choice)
    assert found["cpu_float32"] == found["cuda_float32"] == found["openvino_reduced"] == auto.AGREES
    assert "misses a Pedestrian" in found["cuda_reduced"]
    assert "request it by name" in found["tensorrt_reduced"] and ("tensorrt", "reduced") not in machine.opened
    assert found["openvino_float32"] == "does not run: no AVX"
    line = auto.summary(f"{choice.provider} {choice.precision}", choice.candidates)
    assert line.startswith("auto takes cuda float32: cpu float32 70.0 ms agrees; ") and "\n" not in line


CPU_S = 0.02


@pytest.mark.parametrize(
    ("networks", "taken", "outcome"),
    [
        ({}, ("cpu", "float32"), None),
        ({"openvino_float32": (FOUND, 0.03)}, ("cpu", "float32"), auto.AGREES),
        ({"cuda_float32": (MemoryError(), 0.0)}, ("cpu", "float32"), "does not run: MemoryError"),
        ({"openvino_reduced": (FOUND, 0.018)}, ("openvino", "reduced"), auto.AGREES),
        ({"openvino_reduced": (FOUND, 0.019)}, ("cpu", "float32"), auto.AGREES),  # too little gain for fewer digits
        ({"cpu_float32": (FOUND, 3.0), "openvino_float32": (FOUND, 0.5)}, ("openvino", "float32"), auto.AGREES),
        (
            {"cpu_float32": (FOUND, 0.7), "openvino_reduced": (FOUND, 0.6), "openvino_float32": (FOUND, 0.001)},
            ("openvino", "reduced"),
            "not tried, the 2 s for trials were over: request it by name",
        ),
    ],
)
def test_what_is_taken(networks: dict[str, Any], taken: tuple[str, str], outcome: str | None) -> None:
    """With the outcome of the last candidate."""
    machine = Machine(**({"cpu_float32": (FOUND, CPU_S)} | networks))
    choice = machine.choose()
    assert (choice.provider, choice.precision) == taken
    assert outcome is None or [*outcomes(choice).values()][-1] == outcome


def test_a_precision_that_was_asked_for() -> None:
    machine = Machine(cpu_float32=(FOUND, 0.001), openvino_reduced=(FOUND, 0.02), openvino_float32=(FOUND, 0.03))
    assert machine.choose("reduced")[1:3] == ("openvino", "reduced")
    assert machine.choose("float32")[1:3] == ("cpu", "float32")
    machine = Machine(cpu_float32=(FOUND, 0.01), openvino_reduced=(FOUND[:1], 0.02))
    with pytest.raises(ProviderError, match=r"precision reduced: openvino reduced misses a Car"):
        machine.choose("reduced")
    with pytest.raises(ProviderError, match=r"precision reduced: none is installed, `asca doctor`"):
        Machine(cpu_float32=(FOUND, 0.01)).choose("reduced")


def test_the_detector_says_what_auto_took_and_the_scan_of_the_choice_leaves_nothing_behind(
    tiny_bundle: Path, scan: NDArray[np.float32], caplog: pytest.LogCaptureFixture
) -> None:
    with caplog.at_level(logging.INFO, "asca_pillars"):
        detector = Detector(tiny_bundle, provider="auto", precision="float32")
    assert caplog.messages == [auto.summary(detector.runs_on, detector.candidates)]
    assert (detector.provider, detector.precision) in {(c.provider, c.precision) for c in detector.candidates}
    plain = Detector(tiny_bundle)
    assert plain.candidates == () and len(plain(scan)) > 3
    np.testing.assert_allclose(detector(scan).boxes, plain(scan).boxes, atol=1e-3)
