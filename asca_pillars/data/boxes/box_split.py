"""A dataset with boxes in the LiDAR frame, without a camera and without a calibration.

root/dataset.yaml                 where the rest is; may be empty
     scans/...                    scans of any format, in folders as they come; or anywhere else, by `scans:`
     labels.jsonl or labels.csv   boxes of all frames, or
     labels/<frame>.json or .csv  of each frame (`box_records`), by `labels:`
     ImageSets/train.txt, val.txt one frame id per line

A frame's id is the path of its scan below `scans`, without the suffix. Frames are those that have labels; with one .csv
for all, every scan is a frame and one without a row has no objects.
"""

import zlib
from collections.abc import Container
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path, PurePosixPath
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from asca_pillars.data.boxes.box_records import BoxRecords, read_frame_file, read_frames, records_from
from asca_pillars.data.kitti.kitti_split import read_image_set
from asca_pillars.data.labeled_split import LabeledBoxes
from asca_pillars.data.scans.find_scans import SCAN_SUFFIXES, find_scans
from asca_pillars.data.scans.reflectance import ReflectanceScale
from asca_pillars.data.scans.scan_reader import folder_reflectance_scale, read_scan, stored_points
from asca_pillars.errors import ConfigError, DatasetError
from asca_pillars.schema import Strict
from asca_pillars.settings import read_settings

DATASET_FILE = "dataset.yaml"


@dataclass(frozen=True)
class BoxDataset(Strict):
    """dataset.yaml.

    Attributes:
        scans: folder of the scans, relative to the dataset or absolute.
        labels: a .jsonl or .csv file for all frames, or a folder with a .json or .csv for each; relative or absolute.
        axes: of the scans: `x-forward` (x forward, y left) or `y-forward` (x right, y forward, as nuScenes' LiDAR).
            Labels are always x forward, y left.
        columns: float32 values per point of a .bin; None: four or five, by the values.
        reflectance_scale: the stored value that is a reflectance of 1; auto: by the values of several scans.
    """

    scans: str = "scans"
    labels: str = "labels.jsonl"
    axes: Literal["x-forward", "y-forward"] = "x-forward"
    columns: int | None = None
    reflectance_scale: float | Literal["auto"] = "auto"

    def __post_init__(self) -> None:
        if self.columns is not None and self.columns < 4:
            raise ConfigError(f"columns {self.columns}: a .bin has at least x, y, z and reflectance; give 4 or more")
        if self.reflectance_scale != "auto" and self.reflectance_scale <= 0:
            raise ConfigError(f"reflectance_scale {self.reflectance_scale:g}: must be positive, such as 255, or auto")


class BoxFrame(NamedTuple):
    """A scan and its labels; `file_records` are those of a file for all frames, None where the frame has its own."""

    scan: Path
    label_file: Path
    file_records: BoxRecords | None

    @property
    def records(self) -> BoxRecords:
        """The boxes; DatasetError if the frame's own file is damaged."""
        return read_frame_file(self.label_file) if self.file_records is None else self.file_records


@dataclass(frozen=True)
class BoxSplit:
    """The frames of one list of such a dataset. `name` is a list in ImageSets/, or "training" for every frame."""

    root: str | Path
    name: str = "training"

    has_camera = False
    pool = "scans"

    @cached_property
    def settings(self) -> BoxDataset:
        """The dataset's dataset.yaml; ConfigError if it cannot be used."""
        return read_settings(BoxDataset, Path(self.root) / DATASET_FILE, (), {})

    @property
    def scans_folder(self) -> Path:
        """Where the scans are."""
        return Path(self.root) / self.settings.scans

    @property
    def labels_path(self) -> Path:
        """The file or folder of the labels."""
        return Path(self.root) / self.settings.labels

    @cached_property
    def frame_ids(self) -> tuple[str, ...]:
        """The list's frames, sorted, without repetitions; all of them have a scan and labels.

        Raises:
            DatasetError: the list or the labels are missing, empty or wrong, or have no such frame.
        """
        if self.name == "training":
            return tuple(sorted(self._frames))
        wanted = read_image_set(Path(self.root), self.name)
        if missing := sorted(wanted - set(self._frames)):
            raise DatasetError(
                f"{missing[0]}: listed in ImageSets/{self.name}.txt, but {self.labels_path} has no such frame "
                f"({len(missing)} of {len(wanted)} are missing); a frame without objects needs an entry without boxes"
            )
        return tuple(sorted(wanted))

    def scan_path(self, frame_id: str) -> Path:
        """The frame's scan."""
        return self._frames[frame_id].scan

    def input_paths(self, frame_id: str) -> tuple[Path, ...]:
        """The scan and the file that holds its labels."""
        return self._frames[frame_id].scan, self._frames[frame_id].label_file

    def require_files(self) -> None:
        """Labels name only scans that are there, so that reading the list is enough."""
        self.frame_ids  # noqa: B018

    def points(self, frame_id: str, *, camera_view: bool = False) -> NDArray[np.float32]:
        """(N, 4) of the scan, turned to x forward; there is no camera whose view could be asked for."""
        scale = self._reflectance_scale
        points = read_scan(self.scan_path(frame_id), columns=self.settings.columns, reflectance_scale=scale).points
        return self._turned(points)

    def stored_points(self, frame_id: str) -> NDArray[np.float32]:
        """(N, 4) all of the file, turned; reflectance divided by the dataset's scale."""
        points = stored_points(self.scan_path(frame_id), columns=self.settings.columns)
        if self._reflectance_scale != "auto":
            points[:, 3] /= self._reflectance_scale
        return self._turned(points)

    def points_state(self, frame_id: str) -> tuple[int, ...]:
        """Size and time of the scan, and dataset.yaml."""
        state = self.scan_path(frame_id).stat()
        return state.st_size, state.st_mtime_ns, zlib.crc32(repr(self.settings).encode())

    def label_types(self, frame_id: str) -> list[str]:
        """The class of each box."""
        return list(self.records(frame_id).types)

    def labeled_boxes(self, frame_id: str, types: Container[str] | None = None) -> LabeledBoxes:
        """The frame's boxes, all or those of `types`."""
        records = self.records(frame_id)
        kept = [row for row, kind in enumerate(records.types) if types is None or kind in types]
        return LabeledBoxes(records.boxes[kept], tuple(records.types[row] for row in kept))

    def records(self, frame_id: str) -> BoxRecords:
        """The frame's boxes as they are labelled; DatasetError if its file is damaged."""
        return self._frames[frame_id].records

    @cached_property
    def _reflectance_scale(self) -> ReflectanceScale:
        if self.settings.reflectance_scale != "auto":
            return self.settings.reflectance_scale
        paths = [frame.scan for _, frame in sorted(self._frames.items())]
        return folder_reflectance_scale(paths, columns=self.settings.columns).scale

    def _turned(self, points: NDArray[np.float32]) -> NDArray[np.float32]:
        if self.settings.axes == "x-forward":
            return points
        right, forward = points[:, 0].copy(), points[:, 1].copy()
        points[:, 0], points[:, 1] = forward, -right
        return points

    @cached_property
    def _frames(self) -> dict[str, BoxFrame]:
        """Every labelled frame of the dataset, by its id."""
        return find_frames(self.labels_path, self.scans_folder)


def find_frames(labels: Path, scans: Path) -> dict[str, BoxFrame]:
    """Every labelled frame by its id.

    Args:
        labels: a .jsonl or .csv file for all frames, or a folder with a .json or .csv for each.
        scans: folder that the scans are below.

    Raises:
        DatasetError: labels that are missing, wrong, given twice, or of a scan that is not there.
    """
    if labels.is_dir():
        return _frames_of_folder(labels, scans)
    frames: dict[str, BoxFrame] = {}
    places: dict[str, str] = {}
    if labels.suffix.lower() == ".csv":
        nothing = records_from(np.zeros((0, 7)), ())
        frames = {frame_id_of(path, scans): BoxFrame(path, labels, nothing) for path in find_scans(scans)}
    for scan, records, place in read_frames(labels):
        path = _find_scan(scan, scans, place)
        frame_id = frame_id_of(path, scans)
        if frame_id in places:
            raise DatasetError(f"{place}: {scan} has labels in {places[frame_id]} already; join them")
        frames[frame_id], places[frame_id] = BoxFrame(path, labels, records), place
    if not frames:
        raise DatasetError(f"{labels}: no frame in it; write a line for each scan, as docs/DATA.md says")
    return frames


def frame_id_of(path: Path, scans: Path) -> str:
    """The id of the frame whose scan is at `path`, below the folder `scans`."""
    return path.relative_to(scans).with_suffix("").as_posix()


def _find_scan(scan: str, scans: Path, place: str) -> Path:
    """The longest end of the path `scan` that is a file below `scans`: a label may name its scan from elsewhere."""
    parts = PurePosixPath(scan.replace("\\", "/")).parts
    if ".." not in parts:
        for first in range(len(parts)):
            tail = Path(*parts[first:])
            if not tail.is_absolute() and (scans / tail).is_file():
                return scans / tail
    raise DatasetError(f"{place}: no scan {scan[:200]} below {scans}; correct the name, or `scans` in {DATASET_FILE}")


def _frames_of_folder(labels: Path, scans: Path) -> dict[str, BoxFrame]:
    frames: dict[str, BoxFrame] = {}
    for path in sorted(entry for entry in labels.rglob("*") if entry.suffix.lower() in (".json", ".csv")):
        frame_id = frame_id_of(path, labels)
        there = [scan for suffix in SCAN_SUFFIXES if (scan := scans / f"{frame_id}{suffix}").is_file()]
        if len(there) != 1:
            found = " and ".join(scan.name for scan in there) or "none"
            raise DatasetError(f"{path}: belongs to one scan {scans / frame_id}.*, there is {found}; rename the files")
        if frame_id in frames:
            raise DatasetError(f"{path}: {frames[frame_id].label_file.name} has labels of the scan already; remove one")
        frames[frame_id] = BoxFrame(there[0], path, None)
    if not frames:
        raise DatasetError(f"{labels}: no <frame>.json or <frame>.csv there; write one for each scan")
    return frames
