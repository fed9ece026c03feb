"""What is known of one scan besides its boxes: times, counters, warnings."""

from collections.abc import Sequence
from dataclasses import dataclass, fields


@dataclass(frozen=True)
class ScanCounts:
    """What became of a scan's points: points = kept + points_outside + points_over_limit. Families add their own."""

    points: int
    """Usable points of the scan."""
    points_outside: int
    """Points outside the detector's ranges."""
    points_over_limit: int
    """Points inside that the limits dropped."""


def summed(counts: Sequence[ScanCounts]) -> ScanCounts:
    """The counts of a scan's passes, all of one family, added up."""
    first = counts[0]
    return type(first)(**{name.name: sum(getattr(one, name.name) for one in counts) for name in fields(first)})


@dataclass(frozen=True)
class FrameReport:
    """What happened to one scan on its way to the boxes."""

    times_ms: dict[str, float]
    """Wall time of each stage by name: "input" (check and conversion of the points), then those of the family."""
    waiting_ms: float
    """In a stream: the time between the stages, when the scan waited for those before it. Otherwise 0."""
    counts: ScanCounts
    """What the ranges and the limits made of the usable points; a pillar detector's are `PillarCounts`. Added up over
    the passes, each of which looks at every point."""
    non_finite_points: int
    """Points dropped because a value was NaN or infinite."""
    clipped_reflectances: int
    """Points whose reflectance lay outside 0..1 and was set to the nearer end."""
    non_finite_outputs: int
    """Anchors left out because the network's answer for them was NaN or infinite."""
    warnings: tuple[str, ...]
    """How the scan differs from those the model was trained on, and what was repaired; empty if nothing."""
    passes: int = 1
    """How often the network ran, each time on the scan turned otherwise. Times are those of all passes together."""

    @property
    def total_ms(self) -> float:
        """Latency: from the points to the detections, waiting included."""
        return sum(self.times_ms.values()) + self.waiting_ms
