"""KITTI's label files, and conversion of their camera-frame boxes to and from LiDAR boxes.

A KITTI label gives an upright box in the rectified camera frame: height, width, length, the *bottom* center
x, y, z (x right, y down, z forward) and rotation_y about the y axis, 0 when the object faces x. Such boxes
exist in files only; everything else uses LiDAR boxes (`geometry.boxes`).
"""

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from asca_pillars.base.errors import DatasetError
from asca_pillars.base.files import atomic_path, read_text
from asca_pillars.data.kitti.calibration import DEFAULT_IMAGE_SIZE_WH, Calibration, image_boxes
from asca_pillars.data.yaw_units import yaw_error
from asca_pillars.geometry.boxes import wrap_angle

_TOO_LARGE = 1e9  # of any field; float32 boxes of larger numbers are not finite


@dataclass(frozen=True)
class KittiObject:
    """Object of a label file: pixels in the left color image, metres and radians in the rectified camera.

    `truncated` 0..1 and `occluded` 0..3 are -1 where unknown, `alpha` is the observation angle, `bbox` is
    x1, y1, x2, y2, and `score` is None in ground truth. DontCare areas have only a `bbox`; sizes are -1.
    """

    type: str
    truncated: float
    occluded: int
    alpha: float
    bbox: tuple[float, float, float, float]
    height_m: float
    width_m: float
    length_m: float
    x_m: float
    y_m: float
    z_m: float
    rotation_y: float
    score: float | None = None

    @property
    def has_box_3d(self) -> bool:
        """True if there is a 3D box: not for DontCare areas and 2D detections, whose sizes are -1."""
        return self.type != "DontCare" and min(self.height_m, self.width_m, self.length_m) > 0


def objects_3d(objects: Iterable[KittiObject]) -> list[KittiObject]:
    """Return the objects that have a 3D box, in order."""
    return [item for item in objects if item.has_box_3d]


def read_labels(path: str | Path) -> list[KittiObject]:
    """Read a label file (15 fields per line) or a detection file (16, the last being the score).

    An empty file is a frame without objects: an empty list.

    Raises:
        DatasetError: the file is missing, or a line is not one of KITTI's.
    """
    try:
        text = read_text(path, DatasetError, errors="replace")
    except OSError as error:
        raise DatasetError(
            f"{path}: cannot read the labels ({error.strerror}); a frame without objects needs an empty file"
        ) from error
    lines = enumerate(text.splitlines(), start=1)
    return [parse_object(line.split(), f"{path}:{number}") for number, line in lines if line.strip()]


def write_labels(path: str | Path, objects: Iterable[KittiObject]) -> None:
    """Write a label or detection file as KITTI prints it: two decimals, scores with six."""
    with atomic_path(path) as temporary:
        temporary.write_text(labels_text(objects), encoding="utf-8")


def labels_text(objects: Iterable[KittiObject]) -> str:
    """Return the text of a label or detection file, one line per object, as `write_labels` writes it."""
    return "".join(_format_object(item) + "\n" for item in objects)


def boxes_from_objects(objects: Sequence[KittiObject], calib: Calibration) -> NDArray[np.float32]:
    """Return the LiDAR boxes (N, 7) of labelled objects.

    Center and yaw are transformed by the frame's own calibration. The LiDAR is rotated relative to the camera by up
    to a degree, so yaw is not exactly -rotation_y - pi/2.

    Raises:
        ValueError: an object has no 3D box; filter the list with `objects_3d` first.
    """
    if not all(item.has_box_3d for item in objects):
        raise ValueError("objects without a 3D box are not allowed here: filter with objects_3d() first")
    fields = [(o.x_m, o.y_m - o.height_m / 2, o.z_m, o.length_m, o.width_m, o.height_m, o.rotation_y) for o in objects]
    boxes = np.array(fields, dtype=np.float64).reshape(-1, 7)
    heading_rect = np.stack([np.cos(boxes[:, 6]), -np.sin(boxes[:, 6])], axis=1)
    heading = heading_rect @ _headings_lidar_from_rect(calib).T
    boxes[:, :3] = calib.lidar_from_rect(boxes[:, :3])
    boxes[:, 6] = np.arctan2(heading[:, 1], heading[:, 0])
    lidar_boxes = boxes.astype(np.float32)
    lidar_boxes[:, 6] = wrap_angle(lidar_boxes[:, 6])
    return lidar_boxes


def objects_from_boxes(
    boxes: NDArray[np.floating],
    types: Sequence[str],
    calib: Calibration,
    image_size_wh: Sequence[int] = DEFAULT_IMAGE_SIZE_WH,
    scores: Sequence[float] | NDArray[np.floating] | None = None,
) -> list[KittiObject]:
    """Return the KITTI objects of LiDAR boxes (N, 7): the exact inverse of `boxes_from_objects`.

    `bbox` surrounds the projected corners, clipped to the image; it is -1, -1, -1, -1 for a box outside the
    image, which KITTI's evaluation ignores for its lack of height. Truncation and occlusion are
    unknown: `truncated` and `occluded` are -1, as in KITTI's detection files.
    """
    boxes = np.asarray(boxes, dtype=np.float64).reshape(-1, 7)
    heading = np.stack([np.cos(boxes[:, 6]), np.sin(boxes[:, 6])], axis=1)
    heading_rect = heading @ np.linalg.inv(_headings_lidar_from_rect(calib)).T
    rotation_y = np.arctan2(-heading_rect[:, 1], heading_rect[:, 0])
    x, y, z = calib.rect_from_lidar(boxes[:, :3]).T
    alpha = wrap_angle(rotation_y - np.arctan2(x, z))
    pixels, _ = image_boxes(boxes, calib, image_size_wh)
    return [
        KittiObject(
            type=types[i],
            truncated=-1.0,
            occluded=-1,
            alpha=float(alpha[i]),
            bbox=(float(pixels[i, 0]), float(pixels[i, 1]), float(pixels[i, 2]), float(pixels[i, 3])),
            height_m=float(boxes[i, 5]),
            width_m=float(boxes[i, 4]),
            length_m=float(boxes[i, 3]),
            x_m=float(x[i]),
            y_m=float(y[i] + boxes[i, 5] / 2),
            z_m=float(z[i]),
            rotation_y=float(rotation_y[i]),
            score=None if scores is None else float(scores[i]),
        )
        for i in range(len(boxes))
    ]


def _headings_lidar_from_rect(calib: Calibration) -> NDArray[np.float64]:
    """Return the (2, 2) invertible map from a level direction (x, z) of the camera to (x, y) in the LiDAR frame."""
    return calib.lidar_from_rect_matrix[np.ix_([0, 1], [0, 2])]


def parse_object(words: Sequence[str], place: str) -> KittiObject:
    """Parse the 15 or 16 words of a line; `place` is named in errors.

    Raises:
        DatasetError: the line is not a KITTI label.
    """
    if len(words) not in (15, 16):
        raise DatasetError(
            f"{place}: {len(words)} fields; a KITTI object label has 15 and a detection 16; convert the file"
        )
    values = [_number(word, place) for word in words[1:]]
    truncated, occluded, alpha, x1, y1, x2, y2, height, width, length, x, y, z, rotation_y, *score = values
    if not occluded.is_integer():
        raise DatasetError(f"{place}: occluded is {words[2]}; KITTI has the whole numbers 0 to 3, or -1")
    item = KittiObject(
        type=words[0],
        truncated=truncated,
        occluded=int(occluded),
        alpha=alpha,
        bbox=(x1, y1, x2, y2),
        height_m=height,
        width_m=width,
        length_m=length,
        x_m=x,
        y_m=y,
        z_m=z,
        rotation_y=rotation_y,
        score=score[0] if score else None,
    )
    if item.has_box_3d and (reason := yaw_error(rotation_y)) is not None:
        raise DatasetError(f"{place}: rotation_y {reason}")
    return item


def is_detection_text(text: str) -> bool:
    """Return whether a text holds detections as `labels_text` writes them, with scores, which labels lack."""
    try:
        objects = [parse_object(line.split(), "") for line in text.splitlines()]
    except DatasetError:
        return False
    return all(item.score is not None for item in objects) and labels_text(objects) == text


def _number(word: str, place: str) -> float:
    try:
        value = float(word)
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise DatasetError(f"{place}: '{word}' is not a number; correct the line")
    if abs(value) >= _TOO_LARGE:
        raise DatasetError(f"{place}: '{word}' is too large; correct the line")
    return value


def _format_object(item: KittiObject) -> str:
    box = (item.height_m, item.width_m, item.length_m, item.x_m, item.y_m, item.z_m, item.rotation_y)
    # KITTI prints unknown values (-1, -10, -1000) without decimals; "z" avoids -0.00.
    unknown = item.type == "DontCare"
    fields = [
        item.type,
        "-1" if item.truncated < 0 else f"{item.truncated:.2f}",
        str(item.occluded),
        f"{item.alpha:g}" if unknown else f"{item.alpha:z.2f}",
        *(f"{value:z.2f}" for value in item.bbox),
        *(f"{value:g}" if unknown else f"{value:z.2f}" for value in box),
        *([] if item.score is None else [f"{item.score:z.6f}"]),
    ]
    return " ".join(fields)
