"""The scale of stored reflectances. Sensors and exporters write 0..1, 0..255 or others, and no format says which."""

import math
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from asca_pillars.errors import ScanError

ReflectanceScale = Literal["auto"] | float
"""The stored value that is a reflectance of 1: 1, 100, 255, 65535, any other positive number, or auto."""

# A few values above a scale are specks or retroreflectors; of a scale that is too small there are always more.
_SHARE_ABOVE = 0.001
_SLACK = 2.0  # a scan stored in 0..255 has many values above 2; values just above 1 are common


class Scaled(NamedTuple):
    """Reflectances (N,) float32 in 0..1, NaN where they were not finite, and what was done to them.

    `scale` is what was divided by; `decided_by` says how it was known; `clipped` values lay outside 0..1 after it.
    """

    values: NDArray[np.float32]
    scale: float
    decided_by: Literal["stated", "field type", "values"]
    clipped: int


def checked_scale(scale: ReflectanceScale) -> ReflectanceScale:
    """The scale itself.

    Raises:
        ScanError: it is neither auto nor a positive number.
    """
    if isinstance(scale, str) and scale == "auto":
        return scale
    try:
        number = float(scale)
    except (TypeError, ValueError):
        number = math.nan
    if not (math.isfinite(number) and number > 0):
        raise ScanError(f"reflectance_scale {scale!r}: give auto or the largest value, such as 1, 100, 255 or 65535")
    return number


def unit_reflectance(
    values: NDArray[np.generic], dtype: np.dtype[np.generic] | None = None, scale: ReflectanceScale = "auto"
) -> Scaled:
    """Bring stored reflectances (N,) to 0..1.

    Args:
        values: as stored.
        dtype: the type that the file declares for them; None: that of `values`.
        scale: the value that is a reflectance of 1; auto: `decide_scale`.
    """
    decided_by: Literal["stated", "field type", "values"] = "stated"
    if scale == "auto":
        scale, decided_by = decide_scale(values, dtype)
    with np.errstate(over="ignore", invalid="ignore"):
        reflectance = values.astype(np.float32)
        finite = np.isfinite(reflectance)
        reflectance = np.where(finite, reflectance / np.float32(scale), np.float32(np.nan))
        inside = np.clip(reflectance, 0, 1)
    return Scaled(inside, float(scale), decided_by, int((inside[finite] != reflectance[finite]).sum()))


def decide_scale(
    values: NDArray[np.generic], dtype: np.dtype[np.generic] | None = None
) -> tuple[float, Literal["field type", "values"]]:
    """The scale that reflectances (N,) are stored in: 1, 255 or 65535.

    Bytes are 0..255. Other numbers are taken as 0..1 (integers: as 0..255) unless more than one in a thousand, and
    more than a single one, are too large for it; so one speck does not darken a scan.
    """
    kind = values.dtype if dtype is None else dtype
    if kind.kind in "iu" and kind.itemsize == 1:
        return 255.0, "field type"
    if _many_above(values, 255):
        return 65535.0, "values"
    if kind.kind in "iu":
        return 255.0, "field type"
    return (255.0 if _many_above(values, _SLACK) else 1.0), "values"


def ambiguity(values: NDArray[np.generic], scale: float) -> str | None:
    """A sentence if reflectances (N,) taken as 0..255 may as well be 0..100."""
    if scale != 255 or _many_above(values, 100):
        return None
    return (
        "no reflectance is much above 100 and they were taken as 0..255; if they are 0..100, state that scale "
        "(--reflectance-scale 100)"
    )


def _many_above(values: NDArray[np.generic], limit: float) -> bool:
    with np.errstate(over="ignore", invalid="ignore"):
        above = int((np.greater(values, limit) & np.isfinite(values)).sum())
    return above > max(min(1, len(values) - 1), _SHARE_ABOVE * len(values))
