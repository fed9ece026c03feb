"""Object database: every labelled object of a training list with the points inside its box (section 3.5, step 1).

It is built once, by as many processes as allowed, and stored with the data:

    <prepared>/objects/<list>-<key>.json   its inputs, and the number of objects of each class
                               .npy        concatenated points of all objects: (P, 4) float32
                               .npz        boxes, labels, frames, first

The key is a hash of the settings, of size and time of every file read, and of other inputs of the points
(`points_state`: dataset.yaml). Changed data therefore get another name, and a file's contents never change.
Files are written atomically, the .json last, and two processes building at once write the same bytes. Workers map the
points into memory, which they share.
"""

import contextlib
import hashlib
import json
from collections.abc import Iterable, Sequence
from functools import cached_property, partial
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple

import numpy as np
from numpy.typing import NDArray

from asca_pillars.base.files import portable_name
from asca_pillars.base.processes import map_in_processes
from asca_pillars.base.progress import SILENT, Reporter
from asca_pillars.data.frames import LabeledSplit, read_frame
from asca_pillars.data.insertion.prepared import require_writable, writable_atomic_path
from asca_pillars.geometry.boxes import points_in_boxes

VERSION = 1
_AT_ONCE = 16


class StoredObject(NamedTuple):
    """Object in its own frame: box (7,) and points (N, 4) float32, LiDAR frame, and its class."""

    box: NDArray[np.float32]
    label: int
    points: NDArray[np.float32]


class ObjectDatabase:
    """Database on disk, read on first use; pickling stores its path.

    `len` is the number M of objects, and indexing returns one of them. Objects without points are included: they
    count for the class frequencies.
    """

    def __init__(self, path: Path) -> None:
        self.path = path

    def __reduce__(self) -> tuple[type["ObjectDatabase"], tuple[Path]]:
        return ObjectDatabase, (self.path,)

    def __len__(self) -> int:
        return len(self.labels)

    def __getitem__(self, index: int) -> StoredObject:
        first = self._arrays["first"]
        points = np.array(self._points[first[index] : first[index + 1]])
        return StoredObject(self.boxes[index].copy(), int(self.labels[index]), points)

    @property
    def boxes(self) -> NDArray[np.float32]:
        """(M, 7) boxes, each in the LiDAR frame of its own scan."""
        return self._arrays["boxes"]

    @property
    def labels(self) -> NDArray[np.int64]:
        """(M,) class index of each object."""
        return self._arrays["labels"]

    @property
    def frames(self) -> NDArray[np.int64]:
        """(M,) index, in the list, of the frame of each object."""
        return self._arrays["frames"]

    @property
    def point_counts(self) -> NDArray[np.int64]:
        """(M,) counts of the points of each object."""
        return np.diff(self._arrays["first"])

    @cached_property
    def _arrays(self) -> dict[str, NDArray[Any]]:
        with np.load(self.path.with_suffix(".npz"), allow_pickle=False) as file:
            return {name: file[name] for name in file.files}

    @cached_property
    def _points(self) -> NDArray[np.float32]:
        return np.asarray(np.load(self.path.with_suffix(".npy"), mmap_mode="r", allow_pickle=False))


def prepare_database(
    split: LabeledSplit,
    class_names: Sequence[str],
    prepared: Path,
    *,
    camera_view: bool,
    workers: int = 1,
    reporter: Reporter = SILENT,
) -> ObjectDatabase:
    """Return the database of a list's frames: the existing one if nothing has changed, else a new one.

    Args:
        split: the training list.
        class_names: types of the objects, labels 0, 1, ...
        prepared: folder of per-dataset caches.
        camera_view: keep only points within the camera image.
        workers: processes that read the frames; their number does not change the result.
        reporter: for the progress.

    Raises:
        DatasetError: a frame cannot be read, or the folder cannot be written.
    """
    built_from = {
        "version": VERSION,
        "list": split.name,
        "frames": len(split.frame_ids),
        "class_names": list(class_names),
        "camera_view": camera_view,
    }
    path = prepared / "objects" / f"{portable_name(split.name)}-{_key(split, built_from)}.json"
    if not path.exists():
        require_writable(prepared)
        read = partial(_read_objects, split, tuple(class_names), camera_view)
        title = "Object database"
        objects = map_in_processes(read, split.frame_ids, workers, title, at_once=_AT_ONCE, reporter=reporter)
        _build(path, objects, built_from)
    return ObjectDatabase(path)


def _key(split: LabeledSplit, built_from: dict[str, Any]) -> str:
    digest = hashlib.sha256(json.dumps(built_from).encode())
    for frame_id in split.frame_ids:
        for path in split.input_paths(frame_id):
            # A missing file is reported by its reader.
            state = path.stat() if path.exists() else None
            digest.update(f"{path.name} {state and (state.st_size, state.st_mtime_ns)}\n".encode())
        with contextlib.suppress(FileNotFoundError):
            digest.update(f"{split.points_state(frame_id)}\n".encode())
    return digest.hexdigest()[:16]


class _FrameObjects(NamedTuple):
    """M objects of one frame: boxes (M, 7), labels (M,), their numbers of points (M,), and these points (P, 4)."""

    boxes: NDArray[np.float32]
    labels: NDArray[np.int64]
    counts: NDArray[np.int64]
    points: NDArray[np.float32]


def _read_objects(split: LabeledSplit, class_names: Sequence[str], camera_view: bool, frame_id: str) -> _FrameObjects:
    frame = read_frame(split, frame_id, class_names, camera_view=camera_view, min_points=0)
    labelled = frame.labels >= 0
    inside = points_in_boxes(frame.points, frame.boxes[labelled]).T
    points = frame.points[np.nonzero(inside)[1]]
    return _FrameObjects(frame.boxes[labelled], frame.labels[labelled], inside.sum(axis=1), points)


def _build(path: Path, frames: Iterable[_FrameObjects], built_from: dict[str, Any]) -> None:
    boxes, labels, counts = [np.zeros((0, 7), np.float32)], [np.zeros(0, np.int64)], [np.zeros(1, np.int64)]
    numbers = [np.zeros(0, np.int64)]
    with writable_atomic_path(path.with_suffix(".npy")) as temporary, temporary.open("wb") as file:
        # Points are gigabytes for a large list: they are written to the file directly.
        _write_header(file, 0)
        for number, frame in enumerate(frames):
            boxes.append(frame.boxes)
            labels.append(frame.labels)
            counts.append(frame.counts)
            numbers.append(np.full(len(frame.labels), number))
            file.write(frame.points.tobytes())
        first = np.cumsum(np.concatenate(counts))
        file.seek(0)
        _write_header(file, int(first[-1]))
    all_labels = np.concatenate(labels)
    with writable_atomic_path(path.with_suffix(".npz")) as temporary:
        np.savez(
            temporary,
            boxes=np.concatenate(boxes),
            labels=all_labels,
            frames=np.concatenate(numbers),
            first=first,
        )
    names = built_from["class_names"]
    objects = np.bincount(all_labels, minlength=len(names)).tolist()
    with writable_atomic_path(path) as temporary:
        text = json.dumps({**built_from, "objects": dict(zip(names, objects, strict=True))}, indent=2)
        temporary.write_text(text + "\n", encoding="utf-8")


def _write_header(file: BinaryIO, points: int) -> None:
    """Write the header of an .npy file of (points, 4) float32; its length does not depend on the number of points."""
    header = {"descr": "<f4", "fortran_order": False, "shape": (points, 4)}
    np.lib.format.write_array_header_1_0(file, header)
