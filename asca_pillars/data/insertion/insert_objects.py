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

from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from asca_pillars.base.errors import DatasetError
from asca_pillars.base.progress import SILENT, Reporter
from asca_pillars.config.tree import DataConfig, InsertConfig
from asca_pillars.data.frames import LabeledFrame, other_spelling
from asca_pillars.data.insertion.free_placement import Scene, is_clear, move_to_free_position
from asca_pillars.data.insertion.free_space import FreeSpace, load_free_space
from asca_pillars.data.insertion.gt_database import ObjectDatabase, StoredObject, prepare_database
from asca_pillars.data.insertion.prepared import prepared_folder
from asca_pillars.data.labeled_split import LabeledSplit
from asca_pillars.detection.spec import DetectorSpec
from asca_pillars.geometry.frame_change import FrameChange
from asca_pillars.geometry.ranges import Ranges

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
    wanted = np.array([insert.proportions.get(name, 0.0) for name in spec.class_names])
    if not insert.proportions:
        wanted[:] = 1.0
    shares = insertion_shares(counts / len(split.frame_ids), wanted, insert.objects)
    inserter = Inserter(
        split, insert, spec.ranges, camera_view, data.min_points, prepared, database, tuple(shares.tolist())
    )
    each = zip(spec.class_names, shares, inserter.candidates, strict=True)
    for label, (name, share, objects) in enumerate(each):
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


def insertion_shares(per_frame: NDArray[np.float64], wanted: NDArray[np.float64], objects: int) -> NDArray[np.float64]:
    """Return each class's probability (C,) of insertion, by which the total counts have the wanted proportions.

    A class that has more than its part already gets none; the others are filled up to one level, in units of
    the wanted proportions: sum over classes of max(0, level * wanted - per_frame) = objects.

    Args:
        per_frame: (C,) mean number of objects in a frame.
        wanted: (C,) proportions, not all 0; a class with 0 is not inserted.
        objects: number inserted into each frame.
    """
    shares = np.zeros(len(wanted))
    classes = np.flatnonzero(wanted > 0)
    if objects == 0:
        shares[classes] = wanted[classes] / wanted.sum()
        return shares
    order = classes[np.argsort(per_frame[classes] / wanted[classes])]
    for number in range(1, len(order) + 1):
        filled = order[:number]
        level = (objects + per_frame[filled].sum()) / wanted[filled].sum()
        if number == len(order) or level <= per_frame[order[number]] / wanted[order[number]]:
            break
    shares[filled] = (level * wanted[filled] - per_frame[filled]) / objects
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
