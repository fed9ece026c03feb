"""Colors of classes and heights: the one table for pictures, the browser's page, rerun, Foxglove and ROS markers.

The colors are chosen on a dark background and stay apart for people with protanopia, deuteranopia and tritanopia:
CIE76 differences of 40 and more between cars, pedestrians and cyclists, of 20 and more between any two
(`tests/pictures/test_colors.py`). Nothing is imported here that takes time.
"""

import zlib
from collections.abc import Iterable
from typing import Any

import numpy as np
from numpy.typing import NDArray

Rgb = tuple[int, int, int]
"""Red, green, blue, 0..255."""

CLASS_COLORS: dict[str, Rgb] = {
    "Car": (255, 170, 40),
    "Pedestrian": (255, 85, 115),
    "Cyclist": (70, 205, 255),
}
OTHER_COLORS: tuple[Rgb, ...] = ((150, 120, 255), (220, 238, 145), (240, 105, 200), (175, 140, 40))
"""Colors of classes with other names; the name alone decides which one."""

HEIGHT_RAMP: tuple[Rgb, ...] = ((66, 104, 160), (84, 176, 168), (240, 226, 166))
"""Colors of points from the ground to `HEIGHT_SPAN_M` above it: muted, so that boxes stand out."""
HEIGHT_SPAN_M = 4.0


def class_rgb(name: str) -> Rgb:
    """Return the color of a class: the same everywhere, whatever other classes there are."""
    return CLASS_COLORS.get(name) or OTHER_COLORS[zlib.crc32(name.encode()) % len(OTHER_COLORS)]


def class_shares(name: str) -> tuple[float, float, float]:
    """Return the color of a class as shares of red, green and blue, 0..1, as in WebGL, Foxglove and ROS."""
    red, green, blue = class_rgb(name)
    return red / 255, green / 255, blue / 255


def color_table(names: Iterable[str]) -> dict[str, list[int]]:
    """Return red, green, blue, 0..255, of each class by its name, as JSON holds them."""
    return {name: list(class_rgb(name)) for name in names}


def height_table() -> dict[str, Any]:
    """Return the color ramp of heights as JSON holds it: `ramp`, red, green, blue 0..255, and `span_m`."""
    return {"ramp": [list(color) for color in HEIGHT_RAMP], "span_m": HEIGHT_SPAN_M}


def ground_height(z_m: NDArray[np.floating]) -> float:
    """Return the height (m) at which the color ramp begins: 10th percentile of the points' (N,); 0 without points."""
    return float(np.percentile(z_m, 10)) if len(z_m) else 0.0


def height_rgb(z_m: NDArray[np.floating], ground_m: float) -> NDArray[np.uint8]:
    """Return colors (N, 3), red, green, blue, of points at heights (N,), metres."""
    shares = np.clip((z_m - ground_m) / HEIGHT_SPAN_M, 0, 1)
    stops = np.linspace(0, 1, len(HEIGHT_RAMP))
    channels = [np.interp(shares, stops, [color[channel] for color in HEIGHT_RAMP]) for channel in range(3)]
    return np.round(np.stack(channels, axis=-1)).astype(np.uint8)
