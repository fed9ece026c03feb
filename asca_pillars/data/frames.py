"""Labelled frames, and the interface of a dataset of any layout that they are read from.

`data.kitti.KittiSplit` reads KITTI's layout, `data.boxes.box_split.BoxSplit` the layout with boxes in the LiDAR frame
(docs/DATA.md); `data.open_split` selects between them.
"""

from collections.abc import Container, Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from asca_pillars.detection.anchors import IGNORED
from asca_pillars.geometry.boxes import Ranges, points_in_boxes
from asca_pillars.geometry.frame_change import FrameChange
from asca_pillars.scans.mounting import Mounting

# Types that KITTI's evaluation counts neither as true nor as false positives of a class.
NEIGHBOR_TYPES = {"Car": "Van", "Pedestrian": "Person_sitting"}


def other_spelling(name: str, types: Iterable[str]) -> str | None:
    """Return the one of `types` that differs from `name` in case, blanks or punctuation alone, or None."""
    return next((kind for kind in types if kind != name and _letters(kind) == _letters(name)), None)


def _letters(name: str) -> str:
    return "".join(letter for letter in name.casefold() if letter.isalnum())


class Motion(NamedTuple):
    """Global augmentation of a scene, in this order: flip about the x axis, rotation, scaling, height shift."""

    flipped: bool = False
    rotation_rad: float = 0.0
    scale: float = 1.0
    shift_z_m: float = 0.0


UNMOVED = Motion()


@dataclass(frozen=True)
class LabeledFrame:
    """Frame with its labels.

    Attributes:
        frame_id: name of the frame in its dataset.
        points: (N, 4) float32 x, y, z, reflectance.
        boxes: (M, 7) float32.
        labels: (M,) int64 class index, or IGNORED.
        motion: global augmentation applied so far.
    """

    frame_id: str
    points: NDArray[np.float32]
    boxes: NDArray[np.float32]
    labels: NDArray[np.int64]
    motion: Motion = UNMOVED


class LabeledBoxes(NamedTuple):
    """M labelled boxes of a frame, (M, 7) float32, LiDAR frame, and the type of each."""

    boxes: NDArray[np.float32]
    types: tuple[str, ...]


class LabeledSplit(Protocol):
    """Frames with labelled boxes: one list of a dataset."""

    @property
    def root(self) -> str | Path:
        """Folder of the dataset."""

    @property
    def name(self) -> str:
        """Name of the list; "training" is every frame."""

    @property
    def pool(self) -> str:
        """Namespace of the frame ids: lists of one pool share per-frame caches."""

    @property
    def has_camera(self) -> bool:
        """True if objects are labelled only in a camera's field of view."""

    @property
    def mounting(self) -> Mounting:
        """Pose of the scans' own frame in that of `points` and `labeled_boxes`, with the height if it is stated."""

    @property
    def to_sensor(self) -> FrameChange:
        """Change from the frame of `points` to the same with the sensor at its origin, for occlusion."""

    @property
    def frame_ids(self) -> tuple[str, ...]:
        """Sorted frame ids; DatasetError if the list is missing or invalid."""

    def scan_path(self, frame_id: str) -> Path:
        """Return the path of the frame's scan, for messages; `points` reads it."""

    def input_paths(self, frame_id: str) -> tuple[Path, ...]:
        """Return the files that the frame is read from; caches are outdated when one changes."""

    def require_files(self) -> None:
        """Raise DatasetError unless every frame has its files: training would stop at the first that lacks one."""

    def points(self, frame_id: str, *, camera_view: bool) -> NDArray[np.float32]:
        """Return (N, 4) x, y, z in m, LiDAR frame, and reflectance 0..1; with `camera_view` those in the camera's view.

        Without a camera nothing is cropped.
        """

    def in_labeled_view(self, frame_id: str, positions: NDArray[np.float32]) -> NDArray[np.bool_]:
        """Return the mask of the positions (N, 3), metres, frame of `points`, where objects are labelled."""

    @property
    def one_reflectance_scale(self) -> bool:
        """True if `stored_points` have one scale for all scans; otherwise it is decided for each scan."""

    def stored_points(self, frame_id: str) -> NDArray[np.float32]:
        """Return all points (N, 4) of the file, possibly not finite or with a reflectance outside 0..1."""

    def points_state(self, frame_id: str) -> tuple[int, ...]:
        """Return numbers that change when `points` may change."""

    def label_types(self, frame_id: str) -> list[str]:
        """Return the type of every label, including those without a 3D box."""

    def label_yaws(self, frame_id: str) -> NDArray[np.float64]:
        """Return the stated yaw (M,), or KITTI's rotation_y, of every label with a 3D box; radians unless invalid."""

    def labeled_boxes(self, frame_id: str, types: Container[str] | None = None) -> LabeledBoxes:
        """Return the frame's boxes: those of `types`, or all that have a 3D box.

        Raises:
            DatasetError: missing or damaged labels; an object of `types` without a 3D box.
        """


def read_frame(
    split: LabeledSplit, frame_id: str, class_names: Sequence[str], *, camera_view: bool = True, min_points: int = 1
) -> LabeledFrame:
    """Read points and labelled boxes of one frame.

    Objects of other types are left out; neighbors of a class (KITTI's Van for Car) and objects with too few points
    become IGNORED.

    Args:
        split: the dataset.
        frame_id: one of `split.frame_ids`.
        class_names: types that become labels 0, 1, ...
        camera_view: keep only the points within the camera image; KITTI labels nothing else.
        min_points: an object with fewer points inside its box is IGNORED.

    Raises:
        DatasetError: a missing or damaged file, or an object of a class without a 3D box.
    """
    points = split.points(frame_id, camera_view=camera_view)
    known = {NEIGHBOR_TYPES[name]: IGNORED for name in class_names if name in NEIGHBOR_TYPES}
    known |= {name: index for index, name in enumerate(class_names)}
    boxes, types = split.labeled_boxes(frame_id, known)
    labels = np.array([known[kind] for kind in types], dtype=np.int64)
    if min_points:
        labels[points_in_boxes(points, boxes).sum(axis=0) < min_points] = IGNORED
    return LabeledFrame(frame_id, points, boxes, labels)


def within_ranges(frame: LabeledFrame, ranges: Ranges) -> LabeledFrame:
    """Return the frame without the boxes whose center is outside `ranges`, where there are no anchors."""
    inside = ranges.hold_centers(frame.boxes)
    return replace(frame, boxes=frame.boxes[inside], labels=frame.labels[inside])
