"""Drawing: bird's-eye view, text that does not overlap other text, subpixels."""

from collections.abc import Sequence
from dataclasses import dataclass, field

import cv2
import numpy as np
from numpy.typing import NDArray

from asca_pillars.geometry.boxes import Ranges
from asca_pillars.pictures.colors import HEIGHT_SPAN_M, height_rgb

Image = NDArray[np.uint8]
Color = tuple[int, int, int]

BACKGROUND: Color = (24, 18, 14)
OVERSAMPLING = 2
"""Factor by which bird's-eye views are drawn larger and then averaged down, which smooths even single points."""
SUBPIXEL_BITS = 4
LEGEND_PX, LEGEND_ROW_PX = 200, 22
"""Width kept free for the legend, and height of a row, before oversampling."""
_WHITE: Color = (255, 255, 255)
_GRAY: Color = (190, 180, 172)
_FONT = cv2.FONT_HERSHEY_DUPLEX
_MARGIN_M = 3.0
_MAX_ASPECT = 1.1  # height over width of the picture from above


@dataclass(frozen=True)
class View:
    """Part of the LiDAR's ground plane that a canvas shows, and its scale (pixels of the canvas)."""

    x_max_m: float
    y_max_m: float
    px_per_m: float
    width_px: int
    height_px: int

    @classmethod
    def around(cls, content_xy: NDArray[np.floating], ranges: Ranges, width_px: int) -> "View":
        """Return the part of the ranges that holds the content (N, 2), and the sensor if it is in the range."""
        low, high = np.array([ranges.x_m, ranges.y_m]).T
        has_sensor = bool((low <= 0).all() and (high >= 0).all())
        if len(content_xy):
            content_xy = np.clip(content_xy, low, high)
            low = np.maximum(low, content_xy.min(axis=0) - _MARGIN_M)
            high = np.minimum(high, content_xy.max(axis=0) + _MARGIN_M)
        if has_sensor:
            low, high = np.minimum(low, -_MARGIN_M / 2), np.maximum(high, _MARGIN_M / 2)
        depth_m, breadth_m = high - low
        width = width_px * OVERSAMPLING
        px_per_m = min(width / breadth_m, _MAX_ASPECT * width / depth_m)
        center_y_m = (low[1] + high[1]) / 2
        height = max(round(depth_m * px_per_m / OVERSAMPLING), 1) * OVERSAMPLING
        return cls(float(high[0]), float(center_y_m + width / px_per_m / 2), float(px_per_m), width, height)

    def pixels(self, xy_m: NDArray[np.floating]) -> NDArray[np.float64]:
        """Convert (..., 2) x, y in metres to (..., 2) column, row."""
        return (np.array([self.y_max_m, self.x_max_m]) - xy_m[..., ::-1]) * self.px_per_m

    def shows(self, pixel: NDArray[np.floating], margin_px: float = 0.0) -> bool:
        """Return whether pixels (..., 2) of column, row all lie inside, at least `margin_px` from the border."""
        inner = (margin_px <= pixel) & (pixel <= np.array([self.width_px, self.height_px]) - margin_px)
        return bool(inner.all())


@dataclass(frozen=True, eq=False)
class BoxLayer:
    """Boxes that are drawn alike, and their line in the legend."""

    name: str
    boxes: NDArray[np.floating]
    """(N, 7) LiDAR boxes."""
    color: Color
    texts: Sequence[str] = ()
    """Text beside each box; none if empty."""
    thickness_px: int = 4
    """Width of the outline, before the picture is reduced to half its size."""


@dataclass(frozen=True, eq=False)
class Trail:
    """Places of a box in the scans before."""

    places_m: NDArray[np.floating]
    """(N, 3) x, y, z of the floor's center, oldest first, in the frame of the picture."""
    color: Color


@dataclass
class Texts:
    """Texts on a canvas, placed without overlap."""

    canvas: Image
    scale: float
    background: Color | None = BACKGROUND
    """Color behind the text; None leaves the canvas."""
    taken: list[tuple[float, float, float, float]] = field(default_factory=list)

    def size(self, text: str) -> tuple[int, int]:
        """Return width and height of a text, pixels."""
        (width, height), _ = cv2.getTextSize(text, _FONT, self.scale, 1)
        return width, height

    def reserve(self, x1: float, y1: float, x2: float, y2: float) -> bool:
        """Reserve a rectangle, pixels, if it is free; return whether it was."""
        if any(x1 < b[2] and b[0] < x2 and y1 < b[3] and b[1] < y2 for b in self.taken):
            return False
        self.taken.append((x1, y1, x2, y2))
        return True

    def put(self, text: str, places: Sequence[tuple[float, float]], color: Color) -> None:
        """Write at the first of the places (left end of the base line) that is free; leave it out if none is."""
        if not text:
            return
        width, height = self.size(text)
        for x, y in places:
            x = min(max(x, 2.0), self.canvas.shape[1] - width - 2.0)
            y = min(max(y, height + 2.0), self.canvas.shape[0] - 4.0)
            if self.reserve(x - 2, y - height - 2, x + width + 2, y + 4):
                corners = (round(x - 2), round(y - height - 2)), (round(x + width + 2), round(y + 4))
                if self.background is not None:
                    cv2.rectangle(self.canvas, *corners, self.background, -1)
                cv2.putText(self.canvas, text, (round(x), round(y)), _FONT, self.scale, color, 1, cv2.LINE_AA)
                return


def draw_legend(texts: Texts, layers: Sequence[BoxLayer]) -> None:
    """Draw name, color and number of boxes of each layer, in the upper left corner of an oversampled canvas."""
    line = LEGEND_ROW_PX * OVERSAMPLING
    for number, layer in enumerate(layers):
        left, base = 16 * OVERSAMPLING, 12 * OVERSAMPLING + (number + 1) * line - line // 4
        cv2.rectangle(texts.canvas, (left, base - line // 2), (left + line // 2, base), layer.color, -1)
        texts.put(f"{layer.name}  {len(layer.boxes)}", [(left + line, base)], _WHITE)


def draw_color_bar(texts: Texts) -> None:
    """Draw the legend of the points' colors in the upper right corner of an oversampled canvas."""
    steps, width, height = 64, 10 * OVERSAMPLING, 76 * OVERSAMPLING
    right, top = texts.canvas.shape[1] - 16 * OVERSAMPLING, 16 * OVERSAMPLING
    if texts.canvas.shape[0] < top + height + 60 * OVERSAMPLING or texts.canvas.shape[1] < 400 * OVERSAMPLING:
        return
    ramp = height_rgb(np.linspace(HEIGHT_SPAN_M, 0, steps), 0.0)[:, None, ::-1]
    bar = cv2.resize(np.ascontiguousarray(ramp), (width, height), interpolation=cv2.INTER_LINEAR)
    texts.canvas[top : top + height, right - width : right] = bar
    texts.reserve(right - width, top, right, top + height)
    for text, base in ((f"+{HEIGHT_SPAN_M:g} m", top + 0.0), ("ground", top + height - 1.0)):
        wide, high = texts.size(text)
        texts.put(text, [(right - width - wide - 6 * OVERSAMPLING, base + (high if base == top else 0))], _GRAY)


def mixed(first: Color, second: Color, share: float) -> Color:
    """Mix two colors, with this share, 0..1, of the second."""
    blue, green, red = (round(a + share * (b - a)) for a, b in zip(first, second, strict=True))
    return blue, green, red


def subpixels(pixels: NDArray[np.floating]) -> NDArray[np.int32]:
    """Convert pixel coordinates (..., 2) to OpenCV's fixed-point integers, in 1 / 2**SUBPIXEL_BITS pixel."""
    return np.round(np.clip(pixels, -1e6, 1e6) * 2**SUBPIXEL_BITS).astype(np.int32)
