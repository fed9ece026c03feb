"""The part of bundle.json that follows from `spec`, written out for readers without our geometry code.

The runtime derives these values itself; a bundle with other written values was edited by hand or made by a version with
other features or anchors, and is refused.
"""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from asca_pillars.detection.anchors import ANCHOR_YAWS_RAD
from asca_pillars.ops.pillar.prepare import FEATURES
from asca_pillars.ops.pillar.spec import PillarSpec

_SAME_M = 1e-6


def layout_of(spec: PillarSpec) -> dict[str, Any]:
    """Return plain values for bundle.json.

    x_zones, y_zones: runs of equally sized pillars, ascending: first edge, size and number of pillars.
    canvas_shape: rows and columns of the pseudo-image, the first of each its padding.
    head_shape: (H, W) of the head maps.
    features: channels of the encoder's input. anchor_yaws_rad: the anchors of one class in one head cell.
    """
    return {
        "x_zones": _zones(spec.grid.x_edges_m),
        "y_zones": _zones(spec.grid.y_edges_m),
        "canvas_shape": [size + 1 for size in spec.grid.map_shape],
        "head_shape": list(spec.grid.head_shape),
        "features": list(FEATURES),
        "anchor_yaws_rad": list(ANCHOR_YAWS_RAD),
    }


def difference(written: Any, derived: Any) -> str | None:
    """Return the path of the first value that differs (metres and radians by more than 1e-6), or None."""
    if isinstance(derived, dict | list):
        keys = list(derived) if isinstance(derived, dict) else list(range(len(derived)))
        if not isinstance(written, type(derived)) or len(written) != len(derived):
            return "*"
        for key in keys:
            if isinstance(written, dict) and key not in written:
                return str(key)
            if inner := difference(written[key], derived[key]):
                return str(key) if inner == "*" else f"{key}.{inner}"
        return None
    if isinstance(derived, float) and isinstance(written, float):
        return None if abs(written - derived) <= _SAME_M else "*"
    return None if written == derived else "*"


def _zones(edges_m: NDArray[np.float64]) -> list[dict[str, Any]]:
    sizes_m = np.diff(edges_m)
    borders = np.flatnonzero(np.abs(np.diff(sizes_m)) > _SAME_M) + 1
    starts = [0, *borders.tolist()]
    ends = [*borders.tolist(), len(sizes_m)]
    return [
        {
            "start_m": round(float(edges_m[start]), 9),
            "pillar_m": round(float(edges_m[end] - edges_m[start]) / (end - start), 9),
            "pillars": end - start,
        }
        for start, end in zip(starts, ends, strict=True)
    ]
