"""The result: what was found in one scan."""

import base64
import html
import json
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any, NamedTuple, overload

import numpy as np
from numpy.typing import NDArray

from asca_pillars.detection.report import FrameReport
from asca_pillars.geometry.frame_change import FrameChange
from asca_pillars.geometry.ranges import Ranges

if TYPE_CHECKING:
    from asca_pillars.data.kitti import Calibration

_DIGITS = 4  # tenths of a millimetre


class Detection(NamedTuple):
    """One detected box: center, size and heading in the LiDAR frame (x forward, y left, z up)."""

    class_name: str
    score: float
    """In [0, 1]."""
    x_m: float
    y_m: float
    z_m: float
    """Of the box's center, not of its bottom."""
    length_m: float
    width_m: float
    height_m: float
    yaw_rad: float
    """Counter-clockwise from x, in [-pi, pi)."""

    @property
    def box(self) -> NDArray[np.float32]:
        """(7,) x, y, z, length, width, height, yaw; metres and radians, LiDAR frame."""
        return np.array(self[2:], np.float32)

    @property
    def distance_m(self) -> float:
        """Horizontal distance from the LiDAR to the center."""
        return float(np.hypot(self.x_m, self.y_m))


@dataclass(frozen=True, eq=False, repr=False)
class Detections:
    """N detected boxes, best first. Iterate for `Detection` records, index with a number for one of them.

    A slice, a mask or an array of indices gives a part of them, with the same report.

    Raises:
        ValueError: if the arrays do not describe the same number of boxes.
    """

    boxes: NDArray[np.float32]
    """(N, 7) x, y, z, length, width, height, yaw; metres and radians, LiDAR frame."""
    scores: NDArray[np.float32]
    """(N,) in [0, 1]."""
    labels: NDArray[np.int64]
    """(N,) indices into `class_names`."""
    class_names: tuple[str, ...]
    non_finite: int = 0
    """Anchors whose score was not finite, or whose box was not although its score counted; they were left out."""
    _report: FrameReport | None = None
    _source: Callable[[], NDArray[Any] | None] | None = field(default=None)
    """Weak reference to the points that they were found in."""
    _ranges: Ranges | None = None
    """Where the detector looked, level frame."""
    _level: FrameChange | None = None
    """From the frame of the boxes to a level one, x forward, y left, z up; None: it is such a one."""

    def __post_init__(self) -> None:
        count = len(self.scores) if self.scores.ndim else -1
        if self.boxes.shape != (count, 7) or self.scores.shape != (count,) or self.labels.shape != (count,):
            raise ValueError(
                "boxes, scores and labels must have shapes (N, 7), (N,) and (N,), "
                f"not {self.boxes.shape}, {self.scores.shape} and {self.labels.shape}"
            )

    @classmethod
    def empty(cls, class_names: tuple[str, ...]) -> "Detections":
        """No boxes."""
        return cls(np.empty((0, 7), np.float32), np.empty(0, np.float32), np.empty(0, np.int64), class_names)

    @property
    def report(self) -> FrameReport:
        """Times, counters and warnings of the scan.

        Raises:
            ValueError: no `Detector` made these detections.
        """
        if self._report is None:
            raise ValueError("these detections have no report: a Detector's call or stream gives one")
        return self._report

    def __len__(self) -> int:
        return len(self.boxes)

    def __iter__(self) -> Iterator[Detection]:
        for label, score, box in zip(self.labels.tolist(), self.scores.tolist(), self.boxes.tolist(), strict=True):
            yield Detection(self.class_names[label], score, *box)

    @overload
    def __getitem__(self, index: int | np.integer[Any]) -> Detection: ...
    @overload
    def __getitem__(self, index: slice | NDArray[Any] | list[int]) -> "Detections": ...
    def __getitem__(self, index: int | np.integer[Any] | slice | NDArray[Any] | list[int]) -> "Detection | Detections":
        if isinstance(index, int | np.integer):
            name = self.class_names[self.labels[index]]
            return Detection(name, float(self.scores[index]), *self.boxes[index].tolist())
        part = self.boxes[index], self.scores[index], self.labels[index]
        return Detections(
            *part, self.class_names, self.non_finite, self._report, self._source, self._ranges, self._level
        )

    def __repr__(self) -> str:
        counts = ", ".join(f"{count} {name}" for name, count in Counter(self.names).items())
        return f"<Detections: {counts or 'none'}>"

    def __reduce__(self) -> tuple[Any, ...]:  # the reference to the points stays behind
        kept = (self.boxes, self.scores, self.labels, self.class_names, self.non_finite, self._report, None)
        return Detections, (*kept, self._ranges, self._level)

    @property
    def names(self) -> list[str]:
        """Class name of each detection."""
        return [self.class_names[label] for label in self.labels]

    @property
    def distances_m(self) -> NDArray[np.float32]:
        """(N,) horizontal distance from the LiDAR to each box's center."""
        return np.hypot(self.boxes[:, 0], self.boxes[:, 1])

    @property
    def bearings_rad(self) -> NDArray[np.float32]:
        """(N,) direction of each box's center from straight ahead, radians in [-pi, pi], positive to the left."""
        level = self._level_boxes()
        return np.arctan2(level[:, 1], level[:, 0])

    def to_dicts(self) -> list[dict[str, str | float]]:
        """For each detection `class`, `score` and the fields of `Detection` from `x_m` on, with four decimals."""
        return [
            {"class": found.class_name}
            | {key: round(value, _DIGITS) for key, value in found._asdict().items() if key != "class_name"}
            for found in self
        ]

    def to_json(self) -> str:
        """`to_dicts` as JSON text."""
        return json.dumps(self.to_dicts())

    def to_kitti(self, calibration: "Calibration", image_size_wh: tuple[int, int] | None = None) -> str:
        """KITTI text with scores, one line for each box that the camera sees.

        Args:
            calibration: from `asca_pillars.data.kitti.read_calibration`.
            image_size_wh: width and height of the image in pixels; None for KITTI's usual one.
        """
        from asca_pillars.data.kitti import DEFAULT_IMAGE_SIZE_WH, labels_text, objects_from_boxes

        size = DEFAULT_IMAGE_SIZE_WH if image_size_wh is None else image_size_wh
        objects = objects_from_boxes(self.boxes, self.names, calibration, size, self.scores)
        return labels_text([item for item in objects if item.bbox[2] > item.bbox[0]])

    def plot(
        self,
        points: NDArray[Any] | None = None,
        *,
        labels: NDArray[np.floating] | None = None,
        width_px: int = 1000,
    ) -> NDArray[np.uint8]:
        """The scan and the boxes from above: an image (H, width_px, 3), blue, green, red as in OpenCV; ahead is up.

        A notebook shows it as a picture.

        Args:
            points: (N, >=3) x, y, z in metres, LiDAR frame. None for those that a `Detector` found these boxes in:
                it keeps a weak reference to them, so they are drawn as long as somebody else keeps the array.
            labels: (M, 7) true boxes in the scan's frame, drawn thin and white; None without any.
            width_px: of the image.
        """
        from asca_pillars.pictures.visualize import Picture, draw_bev

        if points is None:
            points = self._source() if self._source is not None else None
        if points is None:
            points = np.empty((0, 4), np.float32)
        points = np.asarray(points)
        found = replace(self, boxes=self._level_boxes())
        if self._level is not None:
            points = self._level.points(points)
            labels = None if labels is None else self._level.boxes(labels)
        ranges = self._ranges
        if ranges is None:
            around = np.concatenate([points[:, :2], found.boxes[:, :2], [[0.0, 0.0]]])
            low, high = around.min(axis=0) - 5.0, around.max(axis=0) + 5.0
            ranges = Ranges((low[0], high[0]), (low[1], high[1]), (-np.inf, np.inf))
        return draw_bev(points, found, ranges, labels=labels, width_px=width_px).view(Picture)

    def _level_boxes(self) -> NDArray[np.float32]:
        return self.boxes if self._level is None else self._level.boxes(self.boxes)

    def _repr_html_(self) -> str:
        """A notebook's view: the picture if the points are still there, and the boxes as a table."""
        rows = "".join(
            f"<tr><td>{html.escape(found.class_name)}</td><td>{found.score:.2f}</td><td>{found.x_m:.1f}</td>"
            f"<td>{found.y_m:.1f}</td><td>{found.length_m:.1f} x {found.width_m:.1f} x {found.height_m:.1f}</td>"
            f"<td>{np.rad2deg(found.yaw_rad):.0f}</td></tr>"
            for found in self
        )
        titles = ("class", "score", "x, m", "y, m", "l x w x h, m", "yaw, degrees")
        head = "".join(f"<th>{title}</th>" for title in titles)
        png = self._repr_png_()
        picture = f'<img src="data:image/png;base64,{base64.b64encode(png).decode()}">' if png else ""
        return f"<div>{picture}<table><tr>{head}</tr>{rows}</table></div>"

    def _repr_png_(self) -> bytes | None:
        """The picture for a notebook; None if the points are gone."""
        if self._source is None or self._source() is None:
            return None
        from asca_pillars.pictures.visualize import png_bytes

        return png_bytes(self.plot())
