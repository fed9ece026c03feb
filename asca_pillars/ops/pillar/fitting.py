"""Whether pillars fill a range as the network needs it and, if not, the nearest settings that would."""

import math

NECK_STRIDE = 8  # stride of the coarsest map in the paper's Table 1
HEAD_STRIDE = 2  # stride of the map that the head reads, Table 1
MAX_ZONES = 5

# How far from a whole number a count of pillars may be: room for float dust (69.12 / 0.32 is not exactly 216)
# and for sizes written with seven digits, and still under a millimetre.
_PILLAR_TOLERANCE = 1e-3


def fits(span_m: tuple[float, float], pillar_m: float, zones: int = 1) -> bool:
    """Whether each of `zones` equal parts of a range is a multiple of NECK_STRIDE of the first one's pillars.

    Columns double from zone to zone, so the map has an odd multiple (2^K - 1) of the first zone's columns,
    and the neck's stride must divide these. Then every zone also holds a multiple of HEAD_STRIDE columns,
    and the borders of zones fall between head cells.
    """
    pillars = (span_m[1] - span_m[0]) / (zones * pillar_m)
    groups = round(pillars / NECK_STRIDE)
    return groups >= 1 and abs(pillars - groups * NECK_STRIDE) <= _PILLAR_TOLERANCE


def x_advice(span_m: tuple[float, float], v_max_m: float, zones: int) -> str:
    """Why an x range does not fit, and the nearest ranges, pillar depth and numbers of zones that do."""
    step_m = NECK_STRIDE * zones * v_max_m
    advice = f"x_range_m {_nearest_ranges(span_m, step_m)}, or v_max_m {_nearest_size(span_m, v_max_m, zones)}"
    working = [str(k) for k in range(1, MAX_ZONES + 1) if fits(span_m, v_max_m, k)]
    if working:
        advice += f", or zones {' or '.join(working)}"
    return (
        f"x_range_m {_show(span_m)} must be a multiple of {step_m:.7g} m "
        f"({zones} zones x {NECK_STRIDE} columns x v_max_m {v_max_m:g}): use {advice}"
    )


def y_advice(span_m: tuple[float, float], v_y_m: float) -> str:
    """Why a y range does not fit, and the nearest ranges and pillar width that do."""
    step_m = NECK_STRIDE * v_y_m
    return (
        f"y_range_m {_show(span_m)} must be a multiple of {step_m:.7g} m "
        f"({NECK_STRIDE} rows x v_y_m {v_y_m:g}): "
        f"use y_range_m {_nearest_ranges(span_m, step_m)}, or v_y_m {_nearest_size(span_m, v_y_m, zones=1)}"
    )


def _nearest_ranges(span_m: tuple[float, float], step_m: float) -> str:
    """The next shorter and longer range: about the origin if `span_m` is, else from the same minimum."""
    low, high = span_m
    steps = math.floor((high - low) / step_m)
    ranges = []
    for length_m in (n * step_m for n in (steps, steps + 1) if n > 0):
        start_m = -length_m / 2 if low == -high else low
        ranges.append(_show((start_m, start_m + length_m)))
    return " or ".join(ranges)


def _nearest_size(span_m: tuple[float, float], pillar_m: float, zones: int) -> str:
    group_m = (span_m[1] - span_m[0]) / (zones * NECK_STRIDE)
    return f"{group_m / max(1, round(group_m / pillar_m)):.7g}"


def _show(span_m: tuple[float, float]) -> str:
    return f"[{span_m[0]:.10g}, {span_m[1]:.10g}]"
