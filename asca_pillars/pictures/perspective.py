"""A scan and its boxes in 3D, as a camera behind and above the sensor would see them: drawn on arrays, BGR."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from asca_pillars.data.kitti.calibration import BOX_EDGES
from asca_pillars.geometry.boxes import Ranges, corners, points_in_boxes
from asca_pillars.pictures.colors import ground_height, height_rgb
from asca_pillars.pictures.drawing import (
    BACKGROUND,
    OVERSAMPLING,
    SUBPIXEL_BITS,
    BoxLayer,
    Color,
    Image,
    Texts,
    Trail,
    draw_color_bar,
    draw_legend,
    mixed,
    subpixels,
)

ASPECT = 9 / 16
"""Height over width of the picture."""
_FIELD_OF_VIEW_RAD = math.radians(52)  # from the left to the right border
_NEAR_M = 0.5
_ZENITH: Color = (15, 11, 8)
_HAZE: Color = (52, 40, 31)
_HAZE_M = 90.0  # colors fade to the haze with this distance
_RING: Color = (120, 104, 92)
_WHITE: Color = (255, 255, 255)
_POINT_M = 0.085  # a point is drawn this large, within limits of pixels
_POINT_PX = (1, 5)
_EGO_M = np.array([[1.7, 0.0], [-1.1, 0.75], [-0.5, 0.0], [-1.1, -0.75]])
_FRONT_FACE = [0, 3, 7, 4]  # rows of `corners`
_FLOOR = [0, 1, 2, 3]


@dataclass(frozen=True)
class ChaseCamera:
    """A pinhole camera in the level LiDAR frame, x forward, y left, z up; it looks from `eye_m` at `target_m`."""

    eye_m: tuple[float, float, float]
    target_m: tuple[float, float, float]
    width_px: int
    height_px: int

    @classmethod
    def behind(cls, ranges: Ranges, ground_m: float, width_px: int) -> "ChaseCamera":
        """Return a camera behind the sensor, higher where the detector looks around; `width_px` wide."""
        height_px = 2 * round(width_px * ASPECT / 2)
        if ranges.x_m[0] < -10:
            return cls((-36.0, 0.0, ground_m + 20.0), (9.0, 0.0, ground_m), width_px, height_px)
        return cls((-17.0, 0.0, ground_m + 9.0), (15.0, 0.0, ground_m + 0.6), width_px, height_px)

    def project(self, places_m: NDArray[np.floating]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Project (..., 3) x, y, z in metres to pixels (..., 2), column and row, and depths (...,) in metres.

        Pixels of points nearer than half a metre, or behind the camera, are meaningless.
        """
        seen = (np.asarray(places_m, np.float64) - self.eye_m) @ self._axes().T
        depth = seen[..., 2]
        pixels = seen[..., :2] * (self._focal_px / np.maximum(depth, _NEAR_M))[..., None]
        return pixels + np.array([self.width_px, self.height_px]) / 2, depth

    def cut(self, starts_m: NDArray[np.floating], ends_m: NDArray[np.floating]) -> NDArray[np.float64]:
        """Project lines from (N, 3) to (N, 3), metres, to pixels (N, 2, 2), clipped at the camera; NaN behind it."""
        ends = np.stack([starts_m, ends_m], axis=1).astype(np.float64)
        depth = (ends - self.eye_m) @ self._axes()[2] - _NEAR_M
        passes = (depth < 0).any(axis=1) & (depth >= 0).any(axis=1)
        share = depth[:, 0] / np.where(passes, depth[:, 0] - depth[:, 1], 1.0)
        crossing = ends[:, 0] + share[:, None] * (ends[:, 1] - ends[:, 0])
        cut = np.where((passes[:, None] & (depth < 0))[:, :, None], crossing[:, None], ends)
        pixels, _ = self.project(cut)
        pixels[(depth < 0).all(axis=1)] = np.nan
        return pixels

    @property
    def _focal_px(self) -> float:
        return self.width_px / 2 / math.tan(_FIELD_OF_VIEW_RAD / 2)

    def _axes(self) -> NDArray[np.float64]:
        """Return the camera's axes as rows: right, down, ahead."""
        ahead = np.subtract(self.target_m, self.eye_m)
        ahead /= np.linalg.norm(ahead)
        right = np.array([ahead[1], -ahead[0], 0.0]) / math.hypot(ahead[0], ahead[1])
        return np.stack([right, np.cross(ahead, right), ahead])


def draw_chase(
    points: NDArray[np.floating],
    layers: Sequence[BoxLayer],
    ranges: Ranges,
    *,
    width_px: int = 1000,
    trails: Sequence[Trail] = (),
    ground_m: float | None = None,
) -> Image:
    """Draw a scan and boxes in 3D, (9/16 width_px, width_px, 3) BGR: points by height, boxes as wireframes.

    Args:
        points: (N, >=3), metres, level LiDAR frame. Those in a box have the color of the box.
        layers: the first is on top and first in the legend. The front of a box is tinted.
        ranges: where the detector looked; they choose the camera.
        width_px: of the picture.
        trails: where boxes were before.
        ground_m: z of the ground; None: estimated from the points.
    """
    places: NDArray[np.float64] = np.asarray(points)[:, :3].astype(np.float64)
    points = places = places[np.isfinite(places).all(axis=1)]
    ground_m = ground_height(points[:, 2]) if ground_m is None else ground_m
    camera = ChaseCamera.behind(ranges, ground_m, OVERSAMPLING * width_px)
    canvas = _sky(camera)
    texts = Texts(canvas, 0.42 * OVERSAMPLING)
    draw_legend(texts, layers)
    draw_color_bar(texts)
    _draw_rings(canvas, camera, ground_m, reach_m=max(ranges.x_m[1], ranges.y_m[1]))
    colors = height_rgb(points[:, 2], ground_m)[:, ::-1].astype(np.float64)
    for layer in reversed(layers):
        colors[points_in_boxes(points, np.asarray(layer.boxes).reshape(-1, 7), 0.05).any(axis=1)] = layer.color
    _draw_points(canvas, camera, places, colors)
    _draw_ego(texts, camera, ground_m)
    for trail in trails:
        _draw_trail(canvas, camera, trail)
    _draw_boxes(texts, camera, layers)
    size = (camera.width_px // OVERSAMPLING, camera.height_px // OVERSAMPLING)
    return np.asarray(cv2.resize(canvas, size, interpolation=cv2.INTER_AREA), dtype=np.uint8)


def _sky(camera: ChaseCamera) -> Image:
    """Draw the empty picture: dark below, a haze at the horizon, darker again above."""
    far = np.add(camera.eye_m, [1e6, 0, 0])
    far[2] = camera.eye_m[2]
    horizon = camera.project(far)[0][1]
    rows = np.arange(camera.height_px)
    below = np.exp(-np.clip(rows - horizon, 0, None) / (0.16 * camera.height_px))
    above = np.exp(-np.clip(horizon - rows, 0, None) / (0.10 * camera.height_px))
    share = np.where(rows < horizon, above, below)[:, None]
    other = np.where((rows < horizon)[:, None], _ZENITH, BACKGROUND)
    column = other + share * (np.array(_HAZE) - other)
    return np.repeat(np.round(column).astype(np.uint8)[:, None], camera.width_px, axis=1)


def _draw_points(canvas: Image, camera: ChaseCamera, points: NDArray[np.float64], colors: NDArray[np.float64]) -> None:
    """Draw points, far ones first, each as a square whose size falls with its distance."""
    pixels, depth = camera.project(points)
    inside = (depth > _NEAR_M) & (pixels >= 0).all(axis=1) & (pixels < (camera.width_px, camera.height_px)).all(axis=1)
    far_first = np.flatnonzero(inside)[np.argsort(-depth[inside], kind="stable")]
    pixels, depth, colors = pixels[far_first], depth[far_first], colors[far_first]
    clear = np.exp(-depth / _HAZE_M)[:, None]
    shades = np.round(np.array(_HAZE) + clear * (colors - np.array(_HAZE))).astype(np.uint8)
    sizes = np.clip(np.round(_POINT_M * camera._focal_px / depth), *_POINT_PX).astype(int)
    for size in range(_POINT_PX[0], _POINT_PX[1] + 1):  # the near are the large: the order by depth is kept
        of_size = sizes == size
        columns, rows = (pixels[of_size] - (size - 1) / 2).astype(np.int64).T
        shade = shades[of_size]
        for down in range(size):
            for right in range(size):
                if size >= 4 and down in (0, size - 1) and right in (0, size - 1):
                    continue  # round corners
                row = np.clip(rows + down, 0, camera.height_px - 1)
                canvas[row, np.clip(columns + right, 0, camera.width_px - 1)] = shade


def _draw_rings(canvas: Image, camera: ChaseCamera, ground_m: float, reach_m: float) -> None:
    """Draw circles of equal distance to the sensor on the ground, with their radius beside the way ahead."""
    angles = np.radians(np.arange(0, 361, 2))
    texts = Texts(canvas, 0.34 * OVERSAMPLING, background=None)
    for radius_m in range(10, math.ceil(reach_m / 10) * 10 + 1, 10):
        circle = np.column_stack([radius_m * np.cos(angles), radius_m * np.sin(angles), np.full(len(angles), ground_m)])
        _, depth = camera.project(circle[0])
        color = _faded(_RING, float(depth))
        for line in camera.cut(circle[:-1], circle[1:]):
            if np.isfinite(line).all():
                cv2.polylines(canvas, [subpixels(line)], False, color, 1, cv2.LINE_AA, SUBPIXEL_BITS)
        if radius_m % 20 == 0:
            side = np.radians(-24)
            pixel, depth = camera.project(np.array([radius_m * np.cos(side), radius_m * np.sin(side), ground_m]))
            if depth > _NEAR_M and (pixel > 0).all() and (pixel < (camera.width_px, camera.height_px)).all():
                texts.put(f"{radius_m} m", [(pixel[0] + 8, pixel[1] - 6)], (170, 160, 150))


def _draw_ego(texts: Texts, camera: ChaseCamera, ground_m: float) -> None:
    """Draw the sensor as an arrow, which no text covers."""
    pixels, depth = camera.project(np.column_stack([_EGO_M, np.full(len(_EGO_M), ground_m + 0.05)]))
    if (depth > _NEAR_M).all():
        cv2.fillPoly(texts.canvas, [subpixels(pixels)], _WHITE, cv2.LINE_AA, SUBPIXEL_BITS)
        texts.reserve(*pixels.min(axis=0), *pixels.max(axis=0))


def _draw_trail(canvas: Image, camera: ChaseCamera, trail: Trail) -> None:
    """Draw a trail from its oldest place, faint, to its newest."""
    count = len(trail.places_m)
    for number, line in enumerate(camera.cut(trail.places_m[:-1], trail.places_m[1:]), start=1):
        if np.isfinite(line).all():
            color = mixed(_HAZE, trail.color, 0.15 + 0.85 * number / count)
            cv2.polylines(canvas, [subpixels(line)], False, color, 2 * OVERSAMPLING, cv2.LINE_AA, SUBPIXEL_BITS)


def _draw_boxes(texts: Texts, camera: ChaseCamera, layers: Sequence[BoxLayer]) -> None:
    """Draw boxes, far ones first, then texts, those of near boxes before others."""
    drawn = [
        (box, layer, layer.texts[row] if layer.texts else "")
        for layer in layers
        for row, box in enumerate(np.asarray(layer.boxes, np.float64).reshape(-1, 7))
    ]
    if not drawn:
        return
    boxes = np.stack([box for box, _, _ in drawn])
    _, depths = camera.project(boxes[:, :3])
    order = np.argsort(-depths, kind="stable")
    for number in order:
        _, layer, _ = drawn[number]
        _draw_box(texts.canvas, camera, boxes[number], layer, float(depths[number]))
    for number in order[::-1]:
        box, layer, text = drawn[number]
        above_m = box[2] + box[5] / 2 + 0.25
        (column, row), depth = camera.project(np.array([box[0], box[1], above_m]))
        if depth > _NEAR_M and 0 < column < camera.width_px and 0 < row < camera.height_px:
            width, height = texts.size(text)
            places = [(column - width / 2, row - lift) for lift in (2, 1.5 * height, 2.8 * height, 4.1 * height)]
            columns = camera.project(corners(box[None])[0])[0][:, 0]
            sides = [(columns.max() + 8, row), (columns.min() - width - 8, row)]
            texts.put(text, places + sides, layer.color)


def _draw_box(canvas: Image, camera: ChaseCamera, box: NDArray[np.float64], layer: BoxLayer, depth_m: float) -> None:
    places = corners(box[None])[0]
    lines = camera.cut(places[BOX_EDGES[:, 0]], places[BOX_EDGES[:, 1]])
    lines = lines[np.isfinite(lines).all(axis=(1, 2))]
    if not len(lines):
        return
    pixels, depths = camera.project(places)
    if (depths > _NEAR_M).all():
        for face, share in ((_FLOOR, 0.16), (_FRONT_FACE, 0.34)):
            _tint(canvas, pixels[face], layer.color, share)
    near = min(1.0, 22.0 / max(depth_m, 1.0))
    thickness = max(2, round(layer.thickness_px * near))
    for line in lines:
        cv2.polylines(canvas, [subpixels(line)], False, layer.color, thickness, cv2.LINE_AA, SUBPIXEL_BITS)
    ahead = np.array([math.cos(box[6]), math.sin(box[6]), 0.0])
    floor = box[:3] - [0, 0, box[5] / 2]
    arrow = camera.cut(
        (floor + ahead * box[3] / 2)[None], (floor + ahead * (box[3] / 2 + min(1.2, 0.2 + 0.4 * box[3])))[None]
    )[0]
    if np.isfinite(arrow).all():
        cv2.polylines(canvas, [subpixels(arrow)], False, layer.color, thickness, cv2.LINE_AA, SUBPIXEL_BITS)


def _tint(canvas: Image, outline: NDArray[np.float64], color: Color, share: float) -> None:
    """Mix a color into what lies in a polygon; only its rectangle is touched."""
    height, width = canvas.shape[:2]
    low = np.clip(np.floor(outline.min(axis=0)).astype(int) - 1, 0, (width, height))
    high = np.clip(np.ceil(outline.max(axis=0)).astype(int) + 2, 0, (width, height))
    part = canvas[low[1] : high[1], low[0] : high[0]]
    if part.size:
        tinted = part.copy()
        cv2.fillPoly(tinted, [subpixels(outline - low)], color, cv2.LINE_AA, SUBPIXEL_BITS)
        part[:] = cv2.addWeighted(tinted, share, part, 1 - share, 0)


def _faded(color: Color, depth_m: float) -> Color:
    return mixed(_HAZE, color, math.exp(-depth_m / (0.6 * _HAZE_M)))
