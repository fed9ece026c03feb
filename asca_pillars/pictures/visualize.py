"""Pictures of scans and boxes, from above and over the camera image: uint8 BGR, as OpenCV has them."""

import math
import struct
import zlib
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from asca_pillars.base.files import atomic_path
from asca_pillars.base.own_files import PICTURE_SOFTWARE
from asca_pillars.data.kitti.calibration import Calibration, project_edges
from asca_pillars.detection.detections import Detections
from asca_pillars.geometry.boxes import Ranges, footprints
from asca_pillars.pictures.colors import class_rgb, ground_height, height_rgb
from asca_pillars.pictures.drawing import (
    BACKGROUND,
    LEGEND_PX,
    LEGEND_ROW_PX,
    OVERSAMPLING,
    SUBPIXEL_BITS,
    BoxLayer,
    Color,
    Image,
    Texts,
    Trail,
    View,
    draw_color_bar,
    draw_legend,
    mixed,
    subpixels,
)

_RING, _GRAY, _WHITE = (74, 62, 54), (190, 180, 172), (255, 255, 255)
_POINT_PX = 3
_PNG_HEADER_BYTES = 33  # signature and IHDR, which other chunks may follow
_RING_TEXT_DEG = (-40, -30, 40, 30, 0, -135, 135, 180)


def class_color(name: str) -> Color:
    """Return the color of a class in OpenCV's order: blue, green, red, 0..255."""
    red, green, blue = class_rgb(name)
    return blue, green, red


def read_image(path: Path) -> Image | None:
    """Read an image file (H, W, 3), blue, green, red; None if it is missing or cannot be decoded."""
    image = cv2.imread(str(path)) if path.is_file() else None
    return None if image is None else image.astype(np.uint8, copy=False)


def write_png(path: str | Path, image: Image) -> None:
    """Write an image (H, W, 3), blue, green, red, as PNG."""
    with atomic_path(path) as temporary:
        temporary.write_bytes(png_bytes(image))


def png_bytes(image: Image) -> bytes:
    """Encode an image (H, W, 3), blue, green, red, as PNG bytes with its origin in the field Software."""
    content = cv2.imencode(".png", image)[1].tobytes()
    text = b"tEXtSoftware\0" + PICTURE_SOFTWARE.encode()
    chunk = struct.pack(f">I{len(text)}sI", len(text) - 4, text, zlib.crc32(text))
    return content[:_PNG_HEADER_BYTES] + chunk + content[_PNG_HEADER_BYTES:]


class Picture(np.ndarray[Any, np.dtype[np.uint8]]):
    """An image array (H, W, 3), blue, green, red, that a notebook shows as a picture."""

    def _repr_png_(self) -> bytes | None:
        return png_bytes(self) if self.ndim == 3 and self.dtype == np.uint8 else None


def draw_bev(
    points: NDArray[np.floating],
    detections: Detections | None,
    ranges: Ranges,
    *,
    labels: NDArray[np.floating] | None = None,
    width_px: int = 1000,
) -> Image:
    """Draw a scan from above: (H, width_px, 3), the LiDAR's x upwards and y to the left.

    Args:
        points: (N, >=3) metres; those in the x and y range are drawn, the higher the brighter.
        detections: drawn in their class's color with their score; a line leads from the center to the front.
        labels: ground truth boxes (M, 7), drawn thin and white.

    The picture shows the part of the ranges in which there is something.
    """
    return draw_layers(points, class_layers(detections, labels), ranges, width_px=width_px)


def class_layers(
    detections: Detections | None, labels: NDArray[np.floating] | None = None, texts: Sequence[str] | None = None
) -> list[BoxLayer]:
    """Return a layer for each class, in its color, and one for ground truth (M, 7) if there is any.

    `texts` stand beside the detections, in their order; None for the scores.
    """
    drawn = Detections.empty(()) if detections is None else detections
    texts = [f"{score:.2f}" for score in drawn.scores] if texts is None else texts
    layers = []
    for label, name in enumerate(drawn.class_names):
        of_class = drawn.labels == label
        named = [text for text, mine in zip(texts, of_class, strict=True) if mine]
        layers.append(BoxLayer(name, drawn.boxes[of_class], class_color(name), named))
    if labels is not None and len(labels):
        layers.append(BoxLayer("ground truth", labels, _WHITE, thickness_px=2))
    return layers


def draw_layers(
    points: NDArray[np.floating],
    layers: Sequence[BoxLayer],
    ranges: Ranges,
    *,
    width_px: int = 1000,
    room_for: NDArray[np.floating] | None = None,
    trails: Sequence[Trail] = (),
    ground_m: float | None = None,
) -> Image:
    """Draw a scan and boxes from above, as `draw_bev`; the first layer is on top and first in the legend.

    Points are (N, >=3), metres, LiDAR frame; the picture is (height, width_px, 3), BGR. With the same boxes (K, 7) as
    `room_for` several pictures of a scan show the same part of it, whatever is drawn in each. `trails` are where boxes
    were before; colors begin at `ground_m`, or at a height estimated from the points.
    """
    points = points[_in_range(points, ranges)]
    outlines = [footprints(np.asarray(layer.boxes, dtype=np.float64).reshape(-1, 7)) for layer in layers]
    corners = [outline.reshape(-1, 2) for outline in outlines]
    if room_for is not None:
        corners.append(footprints(np.asarray(room_for, dtype=np.float64).reshape(-1, 7)).reshape(-1, 2))
    view = View.around(np.concatenate([points[:, :2], *corners]), ranges, width_px)

    canvas = np.full((view.height_px, view.width_px, 3), BACKGROUND, np.uint8)
    texts = Texts(canvas, 0.42 * OVERSAMPLING)
    _draw_rings(texts, view, legend_rows=len(layers))
    _draw_points(canvas, view, points, ground_m)
    for trail in trails:
        _draw_trail(canvas, view, trail)
    for layer, layer_outlines in reversed(list(zip(layers, outlines, strict=True))):
        for outline in layer_outlines:
            _draw_footprint(canvas, view.pixels(outline), layer.color, layer.thickness_px)
    draw_legend(texts, layers)
    draw_color_bar(texts)
    _draw_scale(texts, view)
    for layer, layer_outlines in zip(layers, outlines, strict=True):
        for outline, text in zip(layer_outlines, layer.texts, strict=bool(layer.texts)):
            if view.shows(view.pixels(outline.mean(axis=0))):
                _put_text(texts, view.pixels(outline), text, layer.color)
    size = (view.width_px // OVERSAMPLING, view.height_px // OVERSAMPLING)
    return np.asarray(cv2.resize(canvas, size, interpolation=cv2.INTER_AREA), dtype=np.uint8)


def draw_on_image(
    image: Image,
    boxes: NDArray[np.floating],
    names: Sequence[str],
    scores: Sequence[float] | NDArray[np.floating] | None,
    calib: Calibration,
    *,
    colors: Sequence[Color] | None = None,
) -> Image:
    """Draw LiDAR boxes (N, 7) on a copy of a camera image (H, W, 3) as wireframes with tinted front faces.

    `scores` is None for ground truth, `colors` for those of the classes. Lines behind the camera are cut off.
    """
    colors = [class_color(name) for name in names] if colors is None else colors
    canvas = image.copy()
    edges = project_edges(boxes, calib)
    _, depths_m = calib.project(np.asarray(boxes)[:, :3])
    far_to_near = [int(i) for i in np.argsort(-depths_m, kind="stable") if np.isfinite(edges[i]).any()]
    for i in far_to_near:
        color = colors[i]
        front = edges[i, [3, 11, 7, 8]]
        if np.isfinite(front).all():
            # Corners 3, 0, 4, 7 go round the front. With an edge behind the camera there is nothing to fill.
            face = np.array([front[0, 0], front[0, 1], front[2, 1], front[2, 0]])
            tinted = canvas.copy()
            cv2.fillPoly(tinted, [subpixels(face)], color, cv2.LINE_AA, SUBPIXEL_BITS)
            cv2.addWeighted(tinted, 0.35, canvas, 0.65, 0, dst=canvas)
        thickness = 2 if depths_m[i] < 25 else 1
        for ends in edges[i][np.isfinite(edges[i]).all(axis=(1, 2))]:
            cv2.polylines(canvas, [subpixels(ends)], False, color, thickness, cv2.LINE_AA, SUBPIXEL_BITS)
    texts = Texts(canvas, 0.42)
    for i in reversed(far_to_near):
        visible = edges[i].reshape(-1, 2)
        visible = visible[np.isfinite(visible).all(axis=1)]
        low, high = visible.min(axis=0), visible.max(axis=0)
        if (high > 0).all() and (low < (canvas.shape[1], canvas.shape[0])).all():
            text = names[i] if scores is None else f"{names[i]} {scores[i]:.2f}"
            texts.put(text, [(low[0], low[1] - 5), (low[0], high[1] + 14)], colors[i])
    return np.asarray(canvas, dtype=np.uint8)


def _in_range(points: NDArray[np.floating], ranges: Ranges) -> NDArray[np.bool_]:
    (x_min, x_max), (y_min, y_max) = ranges.x_m, ranges.y_m
    x, y = points[:, 0], points[:, 1]
    return (x >= x_min) & (x < x_max) & (y >= y_min) & (y < y_max)


def _draw_points(canvas: Image, view: View, points: NDArray[np.floating], ground_m: float | None) -> None:
    if not len(points):
        return
    points = points[np.argsort(points[:, 2])]  # the highest last, on top
    ground_m = ground_height(points[:, 2]) if ground_m is None else ground_m
    colors = height_rgb(points[:, 2], ground_m)[:, ::-1]
    columns, rows = view.pixels(points[:, :2]).astype(np.int64).T
    for down in range(_POINT_PX):
        for right in range(_POINT_PX):
            row = np.minimum(rows + down, view.height_px - 1)
            canvas[row, np.minimum(columns + right, view.width_px - 1)] = colors


def _draw_rings(texts: Texts, view: View, legend_rows: int) -> None:
    """Draw circles of equal distance to the sensor, their texts beside the legend, and the sensor as an arrow."""
    legend = np.array([LEGEND_PX, LEGEND_ROW_PX * (legend_rows + 1)]) * OVERSAMPLING
    reach_m = math.hypot(view.x_max_m, max(abs(view.y_max_m), abs(view.y_max_m - view.width_px / view.px_per_m)))
    step_m = 10 if reach_m < 100 else 20
    around = np.radians(np.arange(360))
    circle = np.stack([np.cos(around), np.sin(around)], axis=1)
    for radius_m in range(step_m, math.ceil(reach_m) + 1, step_m):
        ring = view.pixels(radius_m * circle)
        cv2.polylines(texts.canvas, [subpixels(ring)], True, _RING, 2, cv2.LINE_AA, SUBPIXEL_BITS)
        # Beside the way ahead, where there is the least to hide; elsewhere only if the picture does not show that.
        places = [ring[angle_deg] for angle_deg in _RING_TEXT_DEG]
        visible = [pixel for pixel in places if view.shows(pixel, 60) and (pixel > legend).any()]
        if visible:
            texts.put(f"{radius_m} m", [(visible[0][0] - 20, visible[0][1] + 8)], _GRAY)
    arrow = view.pixels(np.array([[1.3, 0], [-0.5, 0.8], [0, 0], [-0.5, -0.8]]))
    cv2.fillPoly(texts.canvas, [subpixels(arrow)], _WHITE, cv2.LINE_AA, SUBPIXEL_BITS)
    texts.reserve(*arrow.min(axis=0), *arrow.max(axis=0))


def _draw_trail(canvas: Image, view: View, trail: Trail) -> None:
    """Draw a trail from its oldest place, faint, to its newest."""
    pixels = view.pixels(trail.places_m[:, :2])
    for number in range(1, len(pixels)):
        color = mixed(BACKGROUND, trail.color, 0.15 + 0.85 * number / len(pixels))
        ends = subpixels(pixels[number - 1 : number + 1])
        cv2.polylines(canvas, [ends], False, color, 2 * OVERSAMPLING, cv2.LINE_AA, SUBPIXEL_BITS)


def _draw_footprint(canvas: Image, outline: NDArray[np.float64], color: Color, thickness: int) -> None:
    front, center = (outline[0] + outline[3]) / 2, outline.mean(axis=0)
    for line, closed in ((outline, True), (np.array([center, front]), False)):
        cv2.polylines(canvas, [subpixels(line)], closed, color, thickness, cv2.LINE_AA, SUBPIXEL_BITS)


def _put_text(texts: Texts, outline: NDArray[np.float64], text: str, color: Color) -> None:
    (left, top), (right, bottom) = outline.min(axis=0), outline.max(axis=0)
    width, height = texts.size(text)
    middle = (top + bottom + height) / 2
    above = ((left + right - width) / 2, top - 8)
    below = (above[0], bottom + height + 8)
    texts.put(text, [(right + 8, middle), (left - width - 8, middle), above, below], color)


def _draw_scale(texts: Texts, view: View) -> None:
    length_m = 10
    right, base = view.width_px - 16 * OVERSAMPLING, view.height_px - 14 * OVERSAMPLING
    left = right - round(length_m * view.px_per_m)
    cv2.line(texts.canvas, (left, base), (right, base), _WHITE, 2 * OVERSAMPLING, cv2.LINE_AA)
    text = f"{length_m} m"
    texts.put(text, [((left + right - texts.size(text)[0]) / 2, base - 6 * OVERSAMPLING)], _WHITE)
