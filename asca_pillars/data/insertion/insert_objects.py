"""GT-Aug and RS-Aug: insertion of labelled objects of other frames into a training frame (section 3.5, steps 5 and 6).

Both sample as many objects, of the same classes and from the same database, so that only the places differ:

- GT-Aug (SECOND): an object keeps its place in its own frame. It must not touch a labelled object.
- RS-Aug: an object is rotated about the sensor's vertical axis to a free place. Its distance is kept, and with it the
  density of its points and its visible side; its height follows the ground. Its footprint with a margin
  must be on free ground, and touch neither a labelled object nor a cluster. Places where it would occlude most of
  another object, or be occluded by one inserted before, are rejected ("avoiding the occlusion of existing objects").

Free ground is visible to the sensor (`free_space`), so nothing in the scan occludes such an object.
Points that an inserted object occludes are removed: every point whose ray enters its box first. The paper does not
state it; without it, walls would be visible through cars. Points of GT-Aug objects behind walls are kept, as in SECOND.
"""

import itertools
import math
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from asca_pillars.base.errors import DatasetError
from asca_pillars.base.progress import SILENT, Reporter
from asca_pillars.config.tree import DataConfig, InsertConfig
from asca_pillars.data.frames import LabeledFrame, LabeledSplit, other_spelling
from asca_pillars.data.insertion.free_space import CELL_M, FreeSpace, load_free_space
from asca_pillars.data.insertion.gt_database import ObjectDatabase, StoredObject, prepare_database
from asca_pillars.data.insertion.prepared import prepared_folder
from asca_pillars.detection.anchors import IGNORED
from asca_pillars.detection.spec import DetectorSpec
from asca_pillars.geometry.boxes import Floating, Floats, Mask, Ranges, Singles, points_in_boxes, wrap_angle
from asca_pillars.geometry.frame_change import FrameChange, transform_columns, transform_points
from asca_pillars.geometry.overlap import paired_bev_touch

PLACE_TRIES = 32  # places tried for one object
CHECKED_PLACES = 4  # places on free ground that are fully checked
MARGIN_M = 0.2  # around the footprint, which must be free too
MIN_SEEN_SHARE = 0.5  # of an object's points


class Scene:
    """Frame with the objects inserted so far.

    Attributes:
        frame: the frame before insertion.
        obstacles: (K, 7) boxes that an inserted one must not touch, metres and radians, LiDAR frame.
        inserted: inserted objects, with all their points.
    """

    def __init__(self, frame: LabeledFrame, obstacles: Singles) -> None:
        self.frame = frame
        self.obstacles = obstacles
        self.inserted: list[StoredObject] = []
        self._seen_points: list[Singles] = []
        inside = points_in_boxes(frame.points, frame.boxes)
        self._owned = np.flatnonzero(inside.any(axis=1))
        self._owners = np.ascontiguousarray(inside[self._owned].T)
        self._wanted = self._owners[frame.labels >= 0]
        self._enough = MIN_SEEN_SHARE * np.count_nonzero(self._wanted, axis=1)
        self._owned_rays = Rays(frame.points[self._owned])
        self._hidden = np.zeros(len(self._owned), bool)

    def add(self, item: StoredObject) -> None:
        """Insert an object at its box."""
        self._hidden |= self._owned_rays.hitting_boxes(item.box[None])
        self._seen_points = [*self._visible_points_with(item), self._visible_points(item)]
        self.inserted.append(item)
        self.obstacles = np.concatenate([self.obstacles, item.box[None]])

    def keeps_all_visible(self, item: StoredObject) -> bool:
        """Return whether most points of every object, `item` included, stay visible if `item` is added."""
        seen = ~(self._hidden | self._owned_rays.hitting_boxes(item.box[None]))
        if (np.count_nonzero(self._wanted & seen, axis=1) < self._enough).any():
            return False
        if len(self._visible_points(item)) < MIN_SEEN_SHARE * len(item.points):
            return False
        after = zip(self._visible_points_with(item), self.inserted, strict=True)
        return all(len(points) >= MIN_SEEN_SHARE * len(other.points) for points, other in after)

    def frame_with_inserted(self, min_points: int) -> LabeledFrame:
        """Return the frame with the objects, without occluded points; objects below `min_points` are IGNORED."""
        if not self.inserted:
            return self.frame
        boxes = np.array([item.box for item in self.inserted])
        seen = ~rays_entering(self.frame.points, boxes)
        labels = self.frame.labels.copy()
        labels[np.count_nonzero(self._owners & seen[self._owned], axis=1) < min_points] = IGNORED
        counts = np.array([len(points) for points in self._seen_points])
        added = np.where(counts >= min_points, [item.label for item in self.inserted], IGNORED)
        return replace(
            self.frame,
            points=np.concatenate([self.frame.points[seen], *self._seen_points]),
            boxes=np.concatenate([self.frame.boxes, boxes]),
            labels=np.concatenate([labels, added.astype(np.int64)]),
        )

    def _visible_points(self, item: StoredObject) -> Singles:
        """Return the points of `item` that no inserted object occludes."""
        hiding = [other.box for other in self.inserted if _share_azimuths(other.box, item.box)]
        return item.points[~rays_entering(item.points, np.array(hiding))] if hiding else item.points

    def _visible_points_with(self, item: StoredObject) -> list[Singles]:
        """Return the points of each inserted object that neither another one nor `item` occludes."""
        return [
            points[~rays_entering(points, item.box[None])] if _share_azimuths(other.box, item.box) else points
            for other, points in zip(self.inserted, self._seen_points, strict=True)
        ]


class Rays:
    """Rays from the sensor to points (N, >=3), LiDAR frame, for many intersection tests."""

    def __init__(self, points: Floating) -> None:
        self._ends = np.ascontiguousarray(points[:, :3].T, dtype=np.float64)
        self._reach = np.hypot(self._ends[0], self._ends[1]) * (1 + 1e-5) + 1e-3

    def hitting_boxes(self, boxes: Floating) -> Mask:
        """Return the mask (N,) of the rays that touch one of boxes (M, 7), LiDAR frame, their ends included."""
        px, py, _ = self._ends
        hits = np.zeros(len(px), bool)
        for x, y, z, length, width, height, yaw in boxes.tolist():
            # Most rays miss the box's circumscribed circle; both sides are scaled by the distance to the point.
            candidates = (np.abs(px * y - py * x) <= math.hypot(length, width) / 2 * self._reach).nonzero()[0]
            if not len(candidates):
                continue
            cos, sin = math.cos(yaw), math.sin(yaw)
            into_box = np.array([[cos, sin, 0], [-sin, cos, 0], [0, 0, 1]])
            ray = transform_columns(self._ends[:, candidates], into_box)
            center = transform_columns(np.array([[x], [y], [z]]), into_box)
            ray[np.abs(ray) < 1e-9] = 1e-9
            half = np.array([[length], [width], [height]]) / 2
            first_side, second_side = (center - half) / ray, (center + half) / ray
            enters = np.minimum(first_side, second_side).max(axis=0)
            leaves = np.maximum(first_side, second_side).min(axis=0)
            hits[candidates] |= (enters <= leaves) & (leaves >= 0) & (enters <= 1)
        return hits


def rays_entering(points: Floating, boxes: Floating) -> Mask:
    """Mask (N,) of the straight lines from the sensor to points (N, >=3) that touch one of boxes (M, 7), ends included.

    All in the LiDAR frame.
    """
    return Rays(points).hitting_boxes(boxes)


def is_clear(box: Floating, obstacles: Floating, ranges: Ranges) -> bool:
    """Return whether a box (7,) is within the ranges and touches none of the others (K, 7), LiDAR frame."""
    reach = (np.hypot(obstacles[:, 3], obstacles[:, 4]) + math.hypot(box[3], box[4])) / 2
    candidates = obstacles[np.hypot(obstacles[:, 0] - box[0], obstacles[:, 1] - box[1]) <= reach]
    if not ranges.hold_centers(box[None])[0]:
        return False
    return not paired_bev_touch(
        np.broadcast_to(box, candidates.shape).astype(np.float64), candidates.astype(np.float64)
    ).any()


def move_to_free_position(
    item: StoredObject, space: FreeSpace, scene: Scene, ranges: Ranges, rng: np.random.Generator
) -> StoredObject | None:
    """Return the object rotated about the sensor's vertical axis to a free place, or None if there is none."""
    distance_m, azimuth_rad = math.hypot(*item.box[:2]), math.atan2(item.box[1], item.box[0])
    cells, distances_m = space.cells
    ring = np.flatnonzero(np.abs(distances_m - distance_m) < CELL_M / 2)
    if space.ground is None or not len(ring):
        return None
    x, y = cells[:, rng.choice(ring, PLACE_TRIES)]
    azimuths = np.arctan2(y, x)
    boxes = np.tile(item.box.astype(np.float64), (PLACE_TRIES, 1))
    boxes[:, 0], boxes[:, 1] = distance_m * np.cos(azimuths), distance_m * np.sin(azimuths)
    boxes[:, 6] = wrap_angle(boxes[:, 6] + azimuths - azimuth_rad)
    obstacles = np.concatenate([scene.obstacles, space.clusters])
    grid_points = _footprint_grid(item.box)
    possible = np.flatnonzero(space.is_free(_placed(grid_points[:4], boxes)).all(axis=1))
    free = (place for place in possible if space.is_free(_placed(grid_points[4:], boxes[place, None])).all())
    for place in itertools.islice(free, CHECKED_PLACES):
        box = boxes[place].astype(np.float32)
        if not is_clear(box, obstacles, ranges):
            continue
        box[2] = space.ground.heights(box[None, :2])[0] + box[5] / 2
        turned = _turned(item, box, float(azimuths[place]) - azimuth_rad)
        if scene.keeps_all_visible(turned):
            return turned
    return None


def _turned(item: StoredObject, box: Singles, turn_rad: float) -> StoredObject:
    """Return the object at its new box (7,), rotated there about the sensor's vertical axis."""
    cos, sin = math.cos(turn_rad), math.sin(turn_rad)
    points = item.points.copy()
    transform_points(points[:, :2], np.array([[cos, -sin], [sin, cos]]), out=points[:, :2])
    points[:, 2] += box[2] - item.box[2]
    return StoredObject(box, item.label, points)


def _footprint_grid(box: Floating) -> Floats:
    """Return offsets (P, 2) along and across a box (7,), over its footprint and margin, the four corners first."""
    length, width = (float(size) + 2 * MARGIN_M for size in box[3:5])
    rows, columns = (math.ceil(size / CELL_M) + 1 for size in (length, width))
    along, across = (np.arange(rows) / (rows - 1) - 0.5) * length, (np.arange(columns) / (columns - 1) - 0.5) * width
    u, v = np.repeat(along, columns), np.tile(across, rows)
    corners = [0, columns - 1, (rows - 1) * columns, rows * columns - 1]
    order = np.r_[corners, np.delete(np.arange(rows * columns), corners)]
    return np.stack([u[order], v[order]], axis=1)


def _placed(offsets: Floats, boxes: Floating) -> Floats:
    """Return offsets (P, 2) along and across boxes (N, 7) as x, y: (N, P, 2)."""
    cos, sin = np.cos(boxes[:, 6, None]), np.sin(boxes[:, 6, None])
    u, v = offsets.T
    return np.stack([boxes[:, 0, None] + cos * u - sin * v, boxes[:, 1, None] + sin * u + cos * v], axis=-1)


def _share_azimuths(a: Floating, b: Floating) -> bool:
    """Return whether one of two boxes (7,) may occlude the other, by their circumscribed circles."""
    widths_rad = sum(
        math.asin(min(math.hypot(box[3], box[4]) / 2 / max(math.hypot(box[0], box[1]), 1e-6), 1.0)) for box in (a, b)
    )
    apart_rad = math.atan2(a[0] * b[1] - a[1] * b[0], a[0] * b[0] + a[1] * b[1])
    return abs(apart_rad) <= widths_rad


OBJECT_TRIES = 10  # objects of a class tried for each insertion


@dataclass(frozen=True)
class Inserter:
    """Insertion of objects into the frames of one list.

    Attributes:
        split: the list.
        settings: number of objects and method.
        ranges: ranges of the detector, in which objects are placed.
        camera_view: whether frames are cropped to the camera image.
        min_points: objects left with fewer points become IGNORED.
        prepared: folder of the free-space maps.
        database: stored objects.
        shares: probability of each class.
    """

    split: LabeledSplit
    settings: InsertConfig
    ranges: Ranges
    camera_view: bool
    min_points: int
    prepared: Path
    database: ObjectDatabase
    shares: tuple[float, ...]

    @cached_property
    def candidates(self) -> tuple[NDArray[np.int64], ...]:
        """Objects of each class that may be inserted: indices (K,) into the database, one array per class."""
        enough = self.database.point_counts >= self.settings.min_points
        return tuple(np.flatnonzero(enough & (self.database.labels == label)) for label in range(len(self.shares)))

    def free_space(self, frame_id: str) -> FreeSpace:
        """Load the free space of a frame."""
        return load_free_space(self.split, frame_id, self.prepared, camera_view=self.camera_view)


def prepare_inserter(
    split: LabeledSplit, spec: DetectorSpec, data: DataConfig, insert: InsertConfig, reporter: Reporter = SILENT
) -> Inserter:
    """Build or find the object database, and compute the probability of each class.

    It is built by as many processes as load batches later (`data.workers`).

    Raises:
        DatasetError: a class is wanted of which no object may be inserted, or the database cannot be built.
    """
    prepared = prepared_folder(split.root, data)
    camera_view = data.camera_view and split.has_camera
    database = prepare_database(
        split, spec.class_names, prepared, camera_view=camera_view, workers=data.workers, reporter=reporter
    )
    counted = (database.point_counts >= data.min_points) & spec.ranges.hold_centers(database.boxes)
    counts = np.bincount(database.labels[counted], minlength=len(spec.class_names))
    proportions = np.array([insert.proportions.get(name, 0.0) for name in spec.class_names])
    if not insert.proportions:
        proportions[:] = 1.0
    shares = insertion_shares(counts / len(split.frame_ids), proportions, insert.objects)
    inserter = Inserter(
        split, insert, spec.ranges, camera_view, data.min_points, prepared, database, tuple(shares.tolist())
    )
    by_class = zip(spec.class_names, shares, inserter.candidates, strict=True)
    for label, (name, share, objects) in enumerate(by_class):
        if share > 0 and not len(objects):
            raise DatasetError(
                _nothing_to_insert(split, name, insert.min_points, int((database.labels == label).sum()))
            )
    return inserter


def _nothing_to_insert(split: LabeledSplit, name: str, min_points: int, objects: int) -> str:
    if not objects:
        types = {kind for frame_id in split.frame_ids for kind in split.label_types(frame_id)}
        other = other_spelling(name, sorted(types))
        remedy = "`asca inspect --propose` writes a configuration with the classes that are labelled"
        if other is not None:
            remedy = f"the labels spell it '{other}'; rename it there or in model.spec.classes"
        return f"{split.root}: list `{split.name}` has no {name} with a point in it; {remedy}"
    return (
        f"{split.root}: list `{split.name}` has no {name} with {min_points} or more points to insert; "
        "lower augment.insert.min_points, or name the other classes in augment.insert.proportions"
    )


def insertion_shares(
    per_frame: NDArray[np.float64], proportions: NDArray[np.float64], objects: int
) -> NDArray[np.float64]:
    """Return each class's probability (C,) of insertion, by which the total counts have these proportions (C,).

    A class that has more than its part already gets none; the others are filled up to one level, in units of
    the proportions: sum over classes of max(0, level * proportions - per_frame) = objects.

    Args:
        per_frame: (C,) mean number of objects in a frame.
        proportions: (C,) proportions, not all 0; a class with 0 is not inserted.
        objects: number inserted into each frame.
    """
    shares = np.zeros(len(proportions))
    classes = np.flatnonzero(proportions > 0)
    if objects == 0:
        shares[classes] = proportions[classes] / proportions.sum()
        return shares
    order = classes[np.argsort(per_frame[classes] / proportions[classes])]
    for number in range(1, len(order) + 1):
        filled = order[:number]
        level = (objects + per_frame[filled].sum()) / proportions[filled].sum()
        if number == len(order) or level <= per_frame[order[number]] / proportions[order[number]]:
            break
    shares[filled] = (level * proportions[filled] - per_frame[filled]) / objects
    return shares


def insert_objects(frame: LabeledFrame, inserter: Inserter, rng: np.random.Generator) -> LabeledFrame:
    """Return the frame with up to `settings.objects` more objects, appended to its own.

    For each, a class is sampled; if an object of it has no free place, another of the same class is tried, so that the
    classes keep their proportions. A frame without free space, or without ground, gets fewer or none. Labelled objects
    occluded by an inserted one become IGNORED, as those occluded in the data.
    """
    change = inserter.split.to_sensor
    space = inserter.free_space(frame.frame_id) if inserter.settings.method == "rs_aug" else None
    labeled = inserter.split.labeled_boxes(frame.frame_id).boxes  # of all types, including unlearned ones
    scene = Scene(_apply_change(frame, change), labeled if change.is_identity else change.boxes(labeled))
    ranges = inserter.ranges.shifted(change.shift_m)
    for label in rng.choice(len(inserter.shares), inserter.settings.objects, p=inserter.shares):
        for _ in range(OBJECT_TRIES):
            item = _apply_change_to_object(inserter.database[int(rng.choice(inserter.candidates[label]))], change)
            if space is not None:
                placed = move_to_free_position(item, space, scene, ranges, rng)
            else:
                placed = item if is_clear(item.box, scene.obstacles, ranges) else None
            if placed is not None:
                scene.add(placed)
                break
    return _apply_change(scene.frame_with_inserted(inserter.min_points), change.inverse)


def _apply_change(frame: LabeledFrame, change: FrameChange) -> LabeledFrame:
    if change.is_identity:
        return frame
    return replace(frame, points=change.points(frame.points), boxes=change.boxes(frame.boxes))


def _apply_change_to_object(item: StoredObject, change: FrameChange) -> StoredObject:
    if change.is_identity:
        return item
    return item._replace(box=change.boxes(item.box[None])[0], points=change.points(item.points))
