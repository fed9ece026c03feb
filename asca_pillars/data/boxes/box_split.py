"""Dataset with boxes in the LiDAR frame, without a camera and without a calibration.

root/dataset.yaml                 paths and settings; may be empty
     scans/...                    scans of any format, in any folders; or elsewhere, by `scans:`
     labels.jsonl or labels.csv   boxes of all frames, or
     labels/<frame>.json or .csv  of each frame (`box_records`), by `labels:`
     ImageSets/train.txt, val.txt one frame id per line

Labels are in the scans' own frame, as `asca detect` writes boxes. Points and boxes are given in the mounting's level
frame: x forward, y left, z up.

A frame's id is the path of its scan below `scans`, without the suffix. Every scan with labels is a frame; with one .csv
for all, every scan is a frame and one without a row has no objects.
"""

import zlib
from collections.abc import Container
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path, PurePosixPath
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from asca_pillars.base.errors import ConfigError, DatasetError
from asca_pillars.base.files import file_inside, is_hidden
from asca_pillars.base.settings import read_settings
from asca_pillars.data.boxes.box_records import BoxRecords, read_frame_file, read_frames, read_time, records_from
from asca_pillars.data.frames import LabeledBoxes
from asca_pillars.data.kitti.kitti_split import read_image_set
from asca_pillars.geometry.frame_change import FrameChange
from asca_pillars.scans.find_scans import SCAN_SUFFIXES, files_below, find_scans, visible_files
from asca_pillars.scans.mounting import Mounting
from asca_pillars.scans.scan_reader import ReflectanceScale, read_scan
from asca_pillars.scans.scan_settings import ScanSettings, folder_reflectance_scale, sample_points, stored_points

DATASET_FILE = "dataset.yaml"
_DEEPEST = 64
"""Largest number of folders of a scan's path in a label that are compared."""


class BoxFrame(NamedTuple):
    """Scan and its labels; records and time of a file for all frames, None if the frame has a file of its own."""

    scan: Path
    label_file: Path
    file_records: BoxRecords | None
    file_time_s: float | None = None

    @property
    def records(self) -> BoxRecords:
        """Boxes of the frame; DatasetError if its own file is damaged."""
        return read_frame_file(self.label_file) if self.file_records is None else self.file_records

    @property
    def time_s(self) -> float | None:
        """Time stamp of the labels, if any; DatasetError as `records`."""
        return read_time(self.label_file) if self.file_records is None else self.file_time_s


def find_frames(labels: Path, scans: Path) -> dict[str, BoxFrame]:
    """Return all labelled frames by their ids.

    Args:
        labels: a .jsonl or .csv file for all frames, or a folder with a .json or .csv for each.
        scans: base folder of the scans.

    Raises:
        DatasetError: labels that are missing, invalid, given twice, or of a missing scan.
    """
    if not scans.is_dir():
        raise DatasetError(f"{scans}: no such folder; give the one that the scans are below as `scans`")
    if labels.is_dir():
        return _frames_of_folder(labels, scans)
    frames: dict[str, BoxFrame] = {}
    places: dict[str, str] = {}
    if labels.suffix.lower() == ".csv":
        nothing = records_from(np.zeros((0, 7)), ())
        for path in find_scans(scans):
            same = frames.setdefault(frame_id_of(path, scans), BoxFrame(path, labels, nothing)).scan
            if same != path:
                raise DatasetError(f"{same} and {path}: both would be frame {frame_id_of(path, scans)}; rename one")
    for scan, records, place, time_s, _ in read_frames(labels):
        scan_path = _find_scan(scan, scans)
        if scan_path is None:
            raise DatasetError(
                f"{place}: no scan {scan[:200]} below {scans}; correct the name, or `scans` in {DATASET_FILE}"
            )
        frame_id = frame_id_of(scan_path, scans)
        if frame_id in places:
            raise DatasetError(f"{place}: {scan} has labels in {places[frame_id]} already; merge them")
        frames[frame_id], places[frame_id] = BoxFrame(scan_path, labels, records, time_s), place
    if not frames:
        raise DatasetError(f"{labels}: contains no frame; write a line for each scan, as docs/DATA.md says")
    return frames


def frame_id_of(path: Path, scans: Path) -> str:
    """Return the id of the frame whose scan is at `path`, below the folder `scans`."""
    return path.relative_to(scans).with_suffix("").as_posix()


def _find_scan(scan: str, scans: Path) -> Path | None:
    """Find the longest end of the path `scan` that is a file below `scans`: labels may have paths of other machines."""
    parts = PurePosixPath(scan.replace("\\", "/")).parts
    if ".." in parts:
        return None
    ends = ("/".join(parts[first:]) for first in range(max(len(parts) - _DEEPEST, 0), len(parts)))
    return next((path for end in ends if (path := file_inside(scans, end)) is not None), None)


def _is_label(relative: Path) -> bool:
    return relative.suffix.lower() in (".json", ".csv") and not is_hidden(relative)


def _frames_of_folder(labels: Path, scans: Path) -> dict[str, BoxFrame]:
    frames: dict[str, BoxFrame] = {}
    for path in sorted(entry for entry in files_below(labels) if _is_label(entry.relative_to(labels))):
        frame_id = frame_id_of(path, labels)
        candidates = [scan for suffix in SCAN_SUFFIXES if (scan := scans / f"{frame_id}{suffix}").is_file()]
        if len(candidates) != 1:
            names = " and ".join(scan.name for scan in candidates) or "none"
            raise DatasetError(f"{path}: belongs to one scan {scans / frame_id}.*, there is {names}; rename the files")
        if frame_id in frames:
            raise DatasetError(f"{path}: {frames[frame_id].label_file.name} has labels of the scan already; remove one")
        frames[frame_id] = BoxFrame(candidates[0], path, None)
    if not frames:
        advice = "write one for each scan"
        if texts := visible_files(labels, "*.txt"):
            advice = (
                f"{texts[0].name} is text: read OpenPCDet's labels with `asca import --from openpcdet`, and KITTI's "
                "without a calibration with `--from kitti-no-camera`"
            )
        raise DatasetError(f"{labels}: no <frame>.json or <frame>.csv there; {advice}")
    return frames


ALL_AROUND_DEG = 360.0


@dataclass(frozen=True)
class BoxDataset(ScanSettings):
    """dataset.yaml: paths of scans and labels, and settings of all scans.

    Attributes:
        scans: folder of the scans, relative to the dataset or absolute.
        labels: a .jsonl or .csv file for all frames, or a folder with a .json or .csv for each; relative or absolute.
        labeled_view_deg: labelled field of view, centered ahead, such as a camera's: data outside are not used in
            training. 360: everywhere.
        sensor_position: x, y, z of the sensor in the scans' own frame, metres, if that is the vehicle's: occlusion by
            inserted objects is computed from there.
    """

    scans: str = "scans"
    labels: str = "labels.jsonl"
    labeled_view_deg: float = ALL_AROUND_DEG
    sensor_position: tuple[float, float, float] = (0.0, 0.0, 0.0)

    def __post_init__(self) -> None:
        super().__post_init__()
        if not 0 < self.labeled_view_deg <= ALL_AROUND_DEG:
            raise ConfigError(f"labeled_view_deg {self.labeled_view_deg:g}: give degrees, 360 for labels everywhere")


@dataclass(frozen=True)
class BoxSplit:
    """Frames of one list of such a dataset. `name` is a list in ImageSets/, or "training" for every frame."""

    root: str | Path
    name: str = "training"

    pool = "scans"
    one_reflectance_scale = True

    @property
    def has_camera(self) -> bool:
        """True if objects are labelled only within an angle ahead."""
        return self.settings.labeled_view_deg < ALL_AROUND_DEG

    @cached_property
    def settings(self) -> BoxDataset:
        """Contents of the dataset's dataset.yaml; ConfigError if it is invalid."""
        return read_settings(BoxDataset, Path(self.root) / DATASET_FILE, (), {})

    @cached_property
    def mounting(self) -> Mounting:
        """Mounting of the sensor; a height of "auto" is estimated on first use.

        Raises:
            ConfigError: the pose cannot be read.
            ScanError: the height cannot be estimated.
        """
        paths = [frame.scan for _, frame in sorted(self._frames.items())]
        return self.settings.mounting(sample_points(paths, self._read), Path(self.root))[0]

    @cached_property
    def to_sensor(self) -> FrameChange:
        """Change from the level frame to the same with the sensor at its origin."""
        (position,) = self._level.points(np.array([self.settings.sensor_position]))
        return FrameChange(np.eye(3), -position.astype(np.float64))

    @property
    def scans_folder(self) -> Path:
        """Folder of the scans."""
        return Path(self.root) / self.settings.scans

    @property
    def labels_path(self) -> Path:
        """File or folder of the labels."""
        return Path(self.root) / self.settings.labels

    @cached_property
    def frame_ids(self) -> tuple[str, ...]:
        """Frames of the list, sorted, without repetitions; all of them have a scan and labels.

        Raises:
            DatasetError: the list or the labels are missing, empty or invalid, or lack a listed frame.
        """
        if self.name == "training":
            return tuple(sorted(self._frames))
        listed = read_image_set(Path(self.root), self.name)
        if missing := sorted(listed - set(self._frames)):
            raise DatasetError(
                f"{missing[0]}: listed in ImageSets/{self.name}.txt, but {self.labels_path} has no such frame "
                f"({len(missing)} of {len(listed)} are missing); a frame without objects needs an entry without boxes"
            )
        return tuple(sorted(listed))

    @cached_property
    def times_s(self) -> dict[str, float]:
        """Time stamps, seconds, of the frames whose labels state one (`time_s`)."""
        return {name: time_s for name in self.frame_ids if (time_s := self._frames[name].time_s) is not None}

    def scan_path(self, frame_id: str) -> Path:
        """Return the path of the frame's scan."""
        return self._frames[frame_id].scan

    def input_paths(self, frame_id: str) -> tuple[Path, ...]:
        """Return the paths of the scan and of its label file."""
        return self._frames[frame_id].scan, self._frames[frame_id].label_file

    def require_files(self) -> None:
        """Raise DatasetError unless every frame has its files: reading the list checks it."""
        self.frame_ids  # noqa: B018

    def points(self, frame_id: str, *, camera_view: bool = False) -> NDArray[np.float32]:
        """Return the scan's points (N, 4), metres, level frame; with `camera_view` those within the labelled angle."""
        points = self._levelled(self._read(self.scan_path(frame_id)))
        return points[self.in_labeled_view(frame_id, points)] if camera_view else points

    def in_labeled_view(self, frame_id: str, positions: NDArray[np.float32]) -> NDArray[np.bool_]:
        """Return the mask of the positions (N, 3 or more), metres, level frame, within the labelled angle."""
        if not self.has_camera:  # the rounded angle straight behind may exceed half a turn
            return np.ones(len(positions), bool)
        angles = np.arctan2(positions[:, 1], positions[:, 0])
        return np.asarray(np.abs(angles) <= np.radians(self.settings.labeled_view_deg / 2))

    def stored_points(self, frame_id: str) -> NDArray[np.float32]:
        """Return all points (N, 4) of the file in the level frame; reflectance divided by the dataset's scale."""
        points = stored_points(self.scan_path(frame_id), columns=self.settings.columns)
        if self._reflectance_scale != "auto":
            points[:, 3] /= self._reflectance_scale
        return self._levelled(points)

    def points_state(self, frame_id: str) -> tuple[int, ...]:
        """Return size and time of the scan, and a checksum of dataset.yaml, its pose and the reflectance scale."""
        state = self.scan_path(frame_id).stat()
        return state.st_size, state.st_mtime_ns, self._settings_crc

    def label_types(self, frame_id: str) -> list[str]:
        """Return the class of each box."""
        return list(self.records(frame_id).types)

    def label_yaws(self, frame_id: str) -> NDArray[np.float64]:
        """Return the yaw (M,) of each box in radians, in the scan's own frame, within half a turn."""
        return self.records(frame_id).boxes[:, 6].astype(np.float64)

    def labeled_boxes(self, frame_id: str, types: Container[str] | None = None) -> LabeledBoxes:
        """Return the frame's boxes in the level frame, all or those of `types`."""
        records = self.records(frame_id)
        kept = [row for row, kind in enumerate(records.types) if types is None or kind in types]
        boxes = records.boxes[kept]
        if not self._level.is_identity:
            boxes = self._level.boxes(boxes)
        return LabeledBoxes(boxes, tuple(records.types[row] for row in kept))

    def records(self, frame_id: str) -> BoxRecords:
        """Return the frame's labelled boxes in the scan's own frame; DatasetError if its file is damaged."""
        return self._frames[frame_id].records

    @cached_property
    def _reflectance_scale(self) -> ReflectanceScale:
        if self.settings.reflectance_scale != "auto":
            return self.settings.reflectance_scale
        paths = [frame.scan for _, frame in sorted(self._frames.items())]
        return folder_reflectance_scale(paths, columns=self.settings.columns).scale

    @cached_property
    def _settings_crc(self) -> int:
        pose = "" if self.settings.pose is None else repr(self.settings.stated_mounting(Path(self.root)).pose)
        scale = self._reflectance_scale if self.settings.reflectance_scale == "auto" else ""
        return zlib.crc32(f"{self.settings!r}{pose}{scale}".encode())

    @cached_property
    def _level(self) -> FrameChange:
        """Change from the scans' own frame to the level frame; needs no height."""
        return self.settings.stated_mounting(Path(self.root)).level

    def _read(self, path: Path) -> NDArray[np.float32]:
        return read_scan(path, columns=self.settings.columns, reflectance_scale=self._reflectance_scale).points

    def _levelled(self, points: NDArray[np.float32]) -> NDArray[np.float32]:
        return points if self._level.is_identity else self._level.points(points)

    @cached_property
    def _frames(self) -> dict[str, BoxFrame]:
        """All labelled frames of the dataset, by id."""
        return find_frames(self.labels_path, self.scans_folder)
