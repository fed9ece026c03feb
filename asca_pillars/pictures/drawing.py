"""What the pictures are made with: the view from above, text that keeps clear of other text, subpixels."""

from collections.abc import Sequence
from dataclasses import dataclass, field

import cv2
import numpy as np
from numpy.typing import NDArray

from asca_pillars.geometry.ranges import Ranges

Image = NDArray[np.uint8]
Color = tuple[int, int, int]

BACKGROUND: Color = (24, 18, 14)
OVERSAMPLING = 2
"""What is seen from above is drawn this much larger and averaged down, which smooths even single points."""
SUBPIXEL_BITS = 4
_FONT = cv2.FONT_HERSHEY_DUPLEX
_MARGIN_M = 3.0
_MAX_ASPECT = 1.1  # height over width of the picture from above


@dataclass(frozen=True)
class View:
    """What part of the LiDAR's ground plane a canvas shows, at which scale (pixels of the canvas)."""

    x_max_m: float
    y_max_m: float
    px_per_m: float
    width_px: int
    height_px: int

    @classmethod
    def around(cls, content_xy: NDArray[np.floating], ranges: Ranges, width_px: int) -> "View":
        """The part of the ranges that holds the content (N, 2), and the sensor if it is in the range."""
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
        """(..., 2) x, y in metres to (..., 2) column, row."""
        return (np.array([self.y_max_m, self.x_max_m]) - xy_m[..., ::-1]) * self.px_per_m

    def shows(self, pixel: NDArray[np.floating], margin_px: float = 0.0) -> bool:
        """Whether pixels (..., 2) of column, row all lie inside, at least `margin_px` from the border."""
        inner = (margin_px <= pixel) & (pixel <= np.array([self.width_px, self.height_px]) - margin_px)
        return bool(inner.all())


@dataclass
class Texts:
    """Text on a canvas that keeps clear of the text put before it."""

    canvas: Image
    scale: float
    taken: list[tuple[float, float, float, float]] = field(default_factory=list)

    def size(self, text: str) -> tuple[int, int]:
        """Width and height of a text, pixels."""
        (width, height), _ = cv2.getTextSize(text, _FONT, self.scale, 1)
        return width, height

    def reserve(self, x1: float, y1: float, x2: float, y2: float) -> bool:
        """Take a rectangle, pixels, if it is free; whether it was."""
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
                cv2.rectangle(self.canvas, *corners, BACKGROUND, -1)
                cv2.putText(self.canvas, text, (round(x), round(y)), _FONT, self.scale, color, 1, cv2.LINE_AA)
                return


def subpixels(pixels: NDArray[np.floating]) -> NDArray[np.int32]:
    """Pixel coordinates (..., 2) as OpenCV's fixed-point integers, in 1 / 2**SUBPIXEL_BITS pixel."""
    return np.round(np.clip(pixels, -1e6, 1e6) * 2**SUBPIXEL_BITS).astype(np.int32)
