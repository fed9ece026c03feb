"""Scope of a detector, stated in every line of its results: its classes and its ranges."""

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from asca_pillars.detection.spec import DetectorSpec
from asca_pillars.geometry.boxes import within

Interval = tuple[float, float]

_FARTHEST_M = 1e6  # larger numbers are errors


class DetectorScope(NamedTuple):
    """Classes of a detector, and its ranges in bird's-eye view.

    `ranges_m` holds (lowest, highest) along x and y, metres, in level axes (x forward, y left); None: every direction.
    """

    classes: tuple[str, ...]
    ranges_m: tuple[Interval, Interval] | None

    def holds(self, boxes: NDArray[np.floating]) -> NDArray[np.bool_]:
        """Return the mask (N,) of the boxes (N, 7), m and rad, level axes, whose center is within the ranges."""
        return within(boxes, self.ranges_m or ())

    def where(self) -> str:
        """Return the ranges in words."""
        if self.ranges_m is None:
            return "every direction"
        (x_low, x_high), (y_low, y_high) = self.ranges_m
        return f"x {x_low:g} to {x_high:g} m and y {y_low:g} to {y_high:g} m"

    def to_json(self) -> dict[str, Any]:
        """Convert to plain values, which `scope_from_json` reads."""
        ranges = None if self.ranges_m is None else [list(interval) for interval in self.ranges_m]
        return {"classes": list(self.classes), "ranges_m": ranges}


def detector_scope(spec: DetectorSpec, *, around: bool) -> DetectorScope:
    """Return the scope of a detector; `around`: it covers every direction, by turned passes."""
    return DetectorScope(spec.class_names, None if around else (spec.ranges.x_m, spec.ranges.y_m))


def scope_from_json(content: Any) -> DetectorScope | None:
    """Parse a stated scope; return None if there is none, as in files of other programs."""
    if not isinstance(content, dict) or "ranges_m" not in content:
        return None
    classes, ranges_m = content.get("classes"), content["ranges_m"]
    if not isinstance(classes, list) or not all(isinstance(name, str) for name in classes):
        return None
    if ranges_m is None:
        return DetectorScope(tuple(classes), None)
    try:
        (x_low, x_high), (y_low, y_high) = ranges_m
        ranges = (float(x_low), float(x_high)), (float(y_low), float(y_high))
    except (TypeError, ValueError, OverflowError):
        return None
    if not all(abs(end) <= _FARTHEST_M for interval in ranges for end in interval):
        return None
    return DetectorScope(tuple(classes), ranges)
