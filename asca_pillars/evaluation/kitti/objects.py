"""Objects of a frame as arrays, for ground truth and detections alike.

Values are those of KITTI's text files, in the rectified camera frame (x right, y down, z forward) and in
pixels of the left color image, because KITTI's protocol uses 2D boxes in addition to 3D ones.
"""

from collections.abc import Sequence
from dataclasses import dataclass, fields
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from asca_pillars.data.kitti.kitti_labels import KittiObject
from asca_pillars.geometry.arrays import Floats


@dataclass(frozen=True, eq=False)
class FrameObjects:
    """N objects of one frame, in the order of the file; N may be 0. All arrays are float64.

    Attributes:
        frame_id: name of the frame's files, without ending.
        types: N type names; "Car" and "car" are the same type.
        bbox: (N, 4) x1, y1, x2, y2 in pixels.
        alpha: (N,) observation angle in radians; -10 where unknown.
        dimensions_hwl: (N, 3) height, width, length in metres; -1 without a 3D box.
        locations: (N, 3) x, y, z of the *bottom* center in metres; -1000 without a 3D box.
        rotation_y: (N,) radians about the y axis, 0 when the object faces x.
        truncated: (N,) 0..1. float32 is not precise enough: float32(0.15) is above KITTI's limit of 0.15.
        occluded: (N,) 0, 1, 2 or 3; -1 where unknown.
        scores: (N,) of detections, any monotonic measure; 0 for ground truth.

    Raises:
        ValueError: an array's shape does not fit the number of types, or it has a value that is not finite.
    """

    frame_id: str
    types: tuple[str, ...]
    bbox: Floats
    alpha: Floats
    dimensions_hwl: Floats
    locations: Floats
    rotation_y: Floats
    truncated: Floats
    occluded: Floats
    scores: Floats

    def __post_init__(self) -> None:
        count = len(self.types)
        widths = {"bbox": (4,), "dimensions_hwl": (3,), "locations": (3,)}
        for name in _ARRAYS:
            array, shape = getattr(self, name), (count, *widths.get(name, ()))
            if array.shape != shape:
                raise ValueError(f"frame {self.frame_id}: {name} is {array.shape}, but {count} types need {shape}")
            if not np.isfinite(array).all():
                raise ValueError(f"frame {self.frame_id}: {name} holds NaN or infinity")

    def __len__(self) -> int:
        return len(self.types)

    @cached_property
    def folded_types(self) -> NDArray[np.str_]:
        """(N,) type names without case, for comparison with `name.casefold()`."""
        return np.array([name.casefold() for name in self.types], dtype=np.str_)

    @property
    def distances_m(self) -> Floats:
        """(N,) horizontal distance from the camera, sqrt(x^2 + z^2), in metres."""
        return np.hypot(self.locations[:, 0], self.locations[:, 2])


_ARRAYS = tuple(field.name for field in fields(FrameObjects) if field.name not in ("frame_id", "types"))


def frame_objects(frame_id: str, objects: Sequence[KittiObject]) -> FrameObjects:
    """Convert the lines of a label or detection file to arrays, in order; the score of a label is 0."""
    rows = [
        (
            *(*item.bbox, item.alpha, item.height_m, item.width_m, item.length_m, item.x_m, item.y_m, item.z_m),
            *(item.rotation_y, item.truncated, item.occluded, item.score or 0.0),
        )
        for item in objects
    ]
    columns = np.array(rows, dtype=np.float64).reshape(-1, 15)
    return FrameObjects(
        frame_id=frame_id,
        types=tuple(item.type for item in objects),
        bbox=columns[:, :4],
        alpha=columns[:, 4],
        dimensions_hwl=columns[:, 5:8],
        locations=columns[:, 8:11],
        rotation_y=columns[:, 11],
        truncated=columns[:, 12],
        occluded=columns[:, 13],
        scores=columns[:, 14],
    )


def concatenate_frames(frames: Sequence[FrameObjects]) -> FrameObjects:
    """Concatenate the objects of all frames, as one frame named ""."""
    if not frames:
        return frame_objects("", [])
    arrays = {name: np.concatenate([getattr(frame, name) for frame in frames], dtype=np.float64) for name in _ARRAYS}
    return FrameObjects("", tuple(name for frame in frames for name in frame.types), **arrays)
