"""What is known of one scan besides its boxes: times, counters, warnings."""

import time
from dataclasses import dataclass

from asca_pillars.pillars.pillarize import PillarCounts

STAGES = ("input", "pillarize", "encode", "scatter", "neck+head", "decode")
GRAPHS = ("encode", "neck+head")  # the stages that are a network's; the others are ours


@dataclass(frozen=True)
class FrameReport:
    """What happened to one scan on its way to the boxes."""

    times_ms: dict[str, float]
    """Wall time of each of STAGES; "input" is the check and conversion of the points."""
    waiting_ms: float
    """In a stream: the time between the stages, when the scan waited for those before it. Otherwise 0."""
    counts: PillarCounts
    """What the grid and the limits made of the finite points."""
    non_finite_points: int
    """Points dropped because a value was NaN or infinite."""
    warnings: tuple[str, ...]
    """How the scan differs from those the model was trained on; empty if it does not."""

    @property
    def total_ms(self) -> float:
        """Latency: from the points to the detections, waiting included."""
        return sum(self.times_ms.values()) + self.waiting_ms


class Stopwatch:
    """Splits the time since its making into named laps and waiting, without gaps."""

    def __init__(self) -> None:
        self.times_ms = dict.fromkeys(STAGES, 0.0)
        self.waiting_ms = 0.0
        self._last = time.perf_counter()

    def lap(self, stage: str) -> None:
        """What has passed since the last lap was `stage`."""
        self.times_ms[stage] += self._since_ms()

    def waited(self) -> None:
        """What has passed since the last lap was waiting for others."""
        self.waiting_ms += self._since_ms()

    def _since_ms(self) -> float:
        last, self._last = self._last, time.perf_counter()
        return (self._last - last) * 1e3
