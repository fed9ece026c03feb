"""Free space of a list's frames on disk: computed when a frame is first used, or all at once."""

from functools import partial
from pathlib import Path
from zipfile import BadZipFile

import numpy as np
from numpy.typing import NDArray

from asca_pillars.base.processes import in_processes
from asca_pillars.data.insertion.free_space import CELLS_PER_NODE, FreeSpace, find_free_space
from asca_pillars.data.insertion.ground_fit import Ground
from asca_pillars.data.insertion.prepared import require_writable, writing
from asca_pillars.data.labeled_split import LabeledSplit

VERSION = 2  # of what is computed; files of another version are computed again
_AT_ONCE = 16


def prepare_free_spaces(split: LabeledSplit, prepared: Path, *, camera_view: bool, workers: int) -> None:
    """Make the files of all frames of a list that are missing or outdated.

    Raises:
        DatasetError: a frame cannot be read, or the folder cannot be written.
    """
    require_writable(prepared)
    job = partial(_prepare, split, prepared, camera_view)
    for _ in in_processes(job, split.frame_ids, workers, "Free ground", at_once=_AT_ONCE):
        pass


def load_free_space(split: LabeledSplit, frame_id: str, prepared: Path, *, camera_view: bool) -> FreeSpace:
    """The free space of a frame, seen from the sensor at its origin (`to_sensor`), from its file below `prepared`.

    It is computed and kept there if missing or outdated.

    Raises:
        DatasetError: the calibration cannot be read, or the folder cannot be written.
        ScanError: the scan cannot be read.
    """
    path = prepared / "free_space" / split.pool / ("camera" if camera_view else "full") / f"{frame_id}.npz"
    stamp = _stamp(split, frame_id)
    if (space := _read(path, stamp)) is not None:
        return space
    points = split.points(frame_id, camera_view=camera_view)
    space = find_free_space(points if split.to_sensor.is_identity else split.to_sensor.points(points))
    _write(path, stamp, space)
    return space


def _stamp(split: LabeledSplit, frame_id: str) -> NDArray[np.int64]:
    """What tells that the files which the map was made from are still the same."""
    return np.array([VERSION, *split.points_state(frame_id)])


def _read(path: Path, stamp: NDArray[np.int64]) -> FreeSpace | None:
    try:
        with path.open("rb") as raw, np.load(raw, allow_pickle=False) as file:
            if not np.array_equal(file["stamp"], stamp):
                return None
            rise, clusters = file["rise_m"], file["clusters"]
            if not rise.size:
                return FreeSpace(None, np.zeros((0, 0), bool), clusters)
            shape = np.array(rise.shape) * CELLS_PER_NODE
            free = np.unpackbits(file["free"], count=shape.prod()).astype(bool).reshape(shape)
            return FreeSpace(Ground(file["plane"], file["origin_m"], rise), free, clusters)
    except (OSError, ValueError, KeyError, EOFError, BadZipFile):  # none there, or a damaged one: it is made again
        return None


def _write(path: Path, stamp: NDArray[np.int64], space: FreeSpace) -> None:
    ground = space.ground or Ground(np.zeros(3), np.zeros(2), np.zeros((0, 0), np.float16))
    with writing(path) as temporary:
        np.savez(
            temporary,
            stamp=stamp,
            plane=ground.plane,
            origin_m=ground.origin_m,
            rise_m=ground.rise_m,
            free=np.packbits(space.free),
            clusters=space.clusters,
        )


def _prepare(split: LabeledSplit, prepared: Path, camera_view: bool, frame_id: str) -> None:
    load_free_space(split, frame_id, prepared, camera_view=camera_view)
