"""The object database: every labelled object of a training list with the points inside its box (section 3.5, step 1).

It is built once and lies beside the data:

    <prepared>/objects/<list>-<key>.json   what it was built from, and how many objects of each class it holds
                               .npy        points of all objects, one after the other: (P, 4) float32
                               .npz        boxes, labels, frames, first

The key is a hash of the settings and of the size and time of every file read. Changed data therefore gets another
name, and what stands under a name never changes. Each file appears whole, the .json last, and two processes that build
at once write the same bytes. Workers map the points into memory, which they share.
"""

import hashlib
import json
from collections.abc import Iterable, Sequence
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from rich.progress import track

from asca_pillars.data.frames import LabeledFrame, read_frame
from asca_pillars.data.insertion.prepared import require_writable, writing
from asca_pillars.data.labeled_split import LabeledSplit
from asca_pillars.geometry.boxes import points_in_boxes

VERSION = 1


class StoredObject(NamedTuple):
    """One object where it stood in its own frame: box (7,) and points (N, 4) float32, LiDAR frame, and its class."""

    box: NDArray[np.float32]
    label: int
    points: NDArray[np.float32]


class ObjectDatabase:
    """A database on disk, read when first used; what is pickled is its path.

    `len` is the number M of objects, and indexing gives one of them. Objects without any point are in it too: they
    tell how often a class occurs.
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
        """(M, 7), each in the LiDAR frame of its own scan."""
        return self._arrays["boxes"]

    @property
    def labels(self) -> NDArray[np.int64]:
        """(M,) class index of each object."""
        return self._arrays["labels"]

    @property
    def frames(self) -> NDArray[np.int64]:
        """(M,) index, in the list, of the frame that each object comes from."""
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
    split: LabeledSplit, class_names: Sequence[str], prepared: Path, *, camera_view: bool
) -> ObjectDatabase:
    """The database of a list's frames: the one on disk if nothing has changed since, else a new one.

    Args:
        split: the training list.
        class_names: types that enter, as labels 0, 1, ...
        prepared: folder for what is computed once per dataset.
        camera_view: only points that the camera sees.

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
    path = prepared / "objects" / f"{split.name}-{_key(split, built_from)}.json"
    if not path.exists():
        require_writable(prepared)
        frames = (
            read_frame(split, frame_id, class_names, camera_view=camera_view, min_points=0)
            for frame_id in track(split.frame_ids, "Object database")
        )
        _build(path, frames, built_from)
    return ObjectDatabase(path)


def _key(split: LabeledSplit, built_from: dict[str, Any]) -> str:
    digest = hashlib.sha256(json.dumps(built_from).encode())
    for frame_id in split.frame_ids:
        for path in split.input_paths(frame_id):
            # A file that is missing is reported, in words, by whoever reads it.
            state = path.stat() if path.exists() else None
            digest.update(f"{path.name} {state and (state.st_size, state.st_mtime_ns)}\n".encode())
    return digest.hexdigest()[:16]


def _build(path: Path, frames: Iterable[LabeledFrame], built_from: dict[str, Any]) -> None:
    names = built_from["class_names"]
    boxes, labels, numbers = [np.zeros((0, 7), np.float32)], [np.zeros(0, np.int64)], [np.zeros(0, np.int64)]
    points = [np.zeros((0, 4), np.float32)]
    for number, frame in enumerate(frames):
        wanted = frame.labels >= 0
        boxes.append(frame.boxes[wanted])
        labels.append(frame.labels[wanted])
        numbers.append(np.full(int(wanted.sum()), number))
        inside = points_in_boxes(frame.points, frame.boxes[wanted])
        points += [frame.points[own] for own in inside.T]
    all_labels = np.concatenate(labels)
    counts = np.bincount(all_labels, minlength=len(names))
    with writing(path.with_suffix(".npy")) as temporary:
        np.save(temporary, np.concatenate(points))
    with writing(path.with_suffix(".npz")) as temporary:
        np.savez(
            temporary,
            boxes=np.concatenate(boxes),
            labels=all_labels,
            frames=np.concatenate(numbers),
            first=np.cumsum([len(own) for own in points]),
        )
    with writing(path) as temporary:
        objects = dict(zip(names, counts.tolist(), strict=True))
        temporary.write_text(json.dumps({**built_from, "objects": objects}, indent=2) + "\n", encoding="utf-8")
