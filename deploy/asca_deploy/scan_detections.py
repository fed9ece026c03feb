"""Result of a detector: the boxes of one scan with its report, as a picture, a table or KITTI text."""

import base64
import html
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from asca_pillars.data.kitti import DEFAULT_IMAGE_SIZE_WH, Calibration, labels_text, objects_from_boxes
from asca_pillars.detection.detections import Detections, FrameReport
from asca_pillars.geometry.boxes import Ranges
from asca_pillars.geometry.frame_change import FrameChange


@dataclass(frozen=True, eq=False, repr=False)
class ScanDetections(Detections):
    """Detections of a `Detector` in one scan; a part of them, by mask or slice, has the same report."""

    report: FrameReport = field(kw_only=True)
    """Times, counters and warnings of the scan."""
    ranges: Ranges = field(kw_only=True)
    """Ranges of the detector, level frame."""
    level: FrameChange | None = field(default=None, kw_only=True)
    """Change from the frame of the boxes to a level one, x forward, y left, z up; None if it is level already."""
    source: Callable[[], NDArray[Any] | None] | None = field(default=None, kw_only=True)
    """Weak reference to the points (N, >=3) that the boxes were found in."""
    made_by: Mapping[str, str] = field(default_factory=dict, kw_only=True)
    """The model, its weights' digest and the version, `Detector.made_by`."""

    def __getstate__(self) -> dict[str, Any]:
        """Return the state without the points, for copies and other processes."""
        return self.__dict__ | {"source": None}

    @property
    def bearings_rad(self) -> NDArray[np.float32]:
        """(N,) direction of each box's center from straight ahead, radians in [-pi, pi], positive to the left."""
        level = self._level_boxes()
        return np.arctan2(level[:, 1], level[:, 0])

    def to_kitti(self, calibration: Calibration, image_size_wh: tuple[int, int] | None = None) -> str:
        """Return KITTI text with scores, one line for each box that the camera sees.

        Args:
            calibration: from `asca_pillars.data.kitti.read_calibration`.
            image_size_wh: width and height of the image in pixels; None for KITTI's usual one.
        """
        size = image_size_wh or DEFAULT_IMAGE_SIZE_WH
        objects = objects_from_boxes(self.boxes, self.names, calibration, size, self.scores)
        return labels_text([item for item in objects if item.bbox[2] > item.bbox[0]])

    def plot(
        self,
        points: NDArray[Any] | None = None,
        *,
        view: Literal["above", "chase"] = "above",
        labels: NDArray[np.floating] | None = None,
        width_px: int = 1000,
    ) -> NDArray[np.uint8]:
        """Draw the scan and the boxes as an image (H, width_px, 3), blue, green, red as in OpenCV.

        A notebook shows it as a picture.

        Args:
            points: (N, >=3) x, y, z in metres, LiDAR frame. None for those that the boxes were found in: only a weak
                reference to them is kept, so they are drawn as long as the caller keeps the array.
            view: "above", where ahead is up, or "chase", in 3D from behind the sensor.
            labels: (M, 7) true boxes in the scan's frame, drawn thin and white; None without any.
            width_px: of the image.

        Raises:
            ValueError: there is no such view.
        """
        # Here: OpenCV takes a tenth of a second, and a vehicle draws nothing.
        from asca_pillars.pictures.perspective import draw_chase
        from asca_pillars.pictures.visualize import Picture, class_layers, draw_layers

        if view not in ("above", "chase"):
            raise ValueError(f"view {view!r}: there are 'above' and 'chase'")
        if points is None:
            points = self._points()
        points = np.empty((0, 4), np.float32) if points is None else np.asarray(points)
        leveled = replace(self, boxes=self._level_boxes())
        if self.level is not None:
            points = self.level.points(points)
            labels = None if labels is None else self.level.boxes(labels)
        draw = draw_chase if view == "chase" else draw_layers
        return draw(points, class_layers(leveled, labels), self.ranges, width_px=width_px).view(Picture)

    def _points(self) -> NDArray[Any] | None:
        return None if self.source is None else self.source()

    def _level_boxes(self) -> NDArray[np.float32]:
        return self.boxes if self.level is None else self.level.boxes(self.boxes)

    def _repr_html_(self) -> str:
        """Return a notebook's view: the picture if the points are still there, and the boxes as a table."""
        rows = "".join(
            f"<tr><td>{html.escape(box.class_name)}</td><td>{box.score:.2f}</td><td>{box.x_m:.1f}</td>"
            f"<td>{box.y_m:.1f}</td><td>{box.length_m:.1f} x {box.width_m:.1f} x {box.height_m:.1f}</td>"
            f"<td>{np.rad2deg(box.yaw_rad):.0f}</td></tr>"
            for box in self
        )
        titles = ("class", "score", "x, m", "y, m", "l x w x h, m", "yaw, degrees")
        head = "".join(f"<th>{title}</th>" for title in titles)
        png = self._repr_png_()
        picture = f'<img src="data:image/png;base64,{base64.b64encode(png).decode()}">' if png else ""
        return f"<div>{picture}<table><tr>{head}</tr>{rows}</table></div>"

    def _repr_png_(self) -> bytes | None:
        """Return the picture for a notebook; None if the points are gone."""
        if self._points() is None:
            return None
        from asca_pillars.pictures.visualize import png_bytes

        return png_bytes(self.plot())
