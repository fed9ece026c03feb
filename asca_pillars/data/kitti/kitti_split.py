"""KITTI's folder layout.

root/training/velodyne/000000.bin   root/testing/velodyne/...
              calib/000000.txt                   calib/...
              label_2/000000.txt                 image_2/...
              image_2/000000.png (optional)
     ImageSets/train.txt, val.txt ...: one frame id per line
"""

import base64
import json
import struct
from collections.abc import Container, Iterable
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from asca_pillars.base.errors import DatasetError, OutputError
from asca_pillars.base.files import atomic_path, read_text, require_content
from asca_pillars.data.frames import LabeledBoxes
from asca_pillars.data.kitti.calibration import DEFAULT_IMAGE_SIZE_WH, Calibration, in_image, read_calibration
from asca_pillars.data.kitti.kitti_labels import KittiObject, boxes_from_objects, objects_3d, read_labels
from asca_pillars.geometry.frame_change import FrameChange
from asca_pillars.scans.find_scans import visible_files
from asca_pillars.scans.mounting import Mounting
from asca_pillars.scans.scan_reader import read_scan
from asca_pillars.scans.scan_settings import stored_points

SIMULATION_FILE = "simulation.json"
"""File in the dataset's folder with the settings of `asca simulate`."""
_PNG = b"\x89PNG\r\n\x1a\n\x00\x00\x00\rIHDR"  # the signature, then length and name of the first chunk


@dataclass(frozen=True)
class KittiSplit:
    """Frames of one split of a KITTI-layout dataset.

    `name` is a folder, "training" or "testing" (every scan in it), or the name of a list below ImageSets/
    ("train", "val", "trainval": frames of training/; "test": frames of testing/).
    """

    root: str | Path
    name: str = "training"

    one_reflectance_scale = False
    mounting = Mounting()

    @cached_property
    def has_camera(self) -> bool:
        """True if only the camera's view is labelled: always except in frames of `asca simulate --view around`.

        Raises:
            DatasetError: the file of the simulation's settings is damaged.
        """
        path = Path(self.root) / SIMULATION_FILE
        try:
            about = json.loads(path.read_text(encoding="utf-8"))
        except FileNotFoundError:
            return True
        except (OSError, ValueError) as error:
            raise DatasetError(f"{path}: cannot be read ({' '.join(str(error).split())}); simulate it anew") from None
        return not (isinstance(about, dict) and about.get("field_of_view") == "around")

    @property
    def pool(self) -> str:
        """Folder name, training or testing."""
        return self.folder.name

    @property
    def folder(self) -> Path:
        """root/training or root/testing."""
        return Path(self.root) / ("testing" if self.name in ("test", "testing") else "training")

    @cached_property
    def frame_ids(self) -> tuple[str, ...]:
        """Frames of the split, sorted, without repetitions; all of them have a scan.

        Raises:
            DatasetError: the folder or list is missing or empty, or a listed scan does not exist.
        """
        scans = {path.stem for path in visible_files(self.folder / "velodyne", "*.bin")}
        if not scans:
            raise DatasetError(
                f"{self.folder / 'velodyne'}: no *.bin scans there; KITTI's layout is "
                "<root>/training/{velodyne,calib,label_2}, and <root> is what to give"
            )
        if self.name in ("training", "testing"):
            return tuple(sorted(scans))
        listed = read_image_set(Path(self.root), self.name)
        if missing := sorted(listed - scans):
            raise DatasetError(
                f"{self.scan_path(missing[0])}: listed in ImageSets/{self.name}.txt but not there "
                f"({len(missing)} of {len(listed)} scans are missing); complete the folder or the list"
            )
        return tuple(sorted(listed))

    def scan_path(self, frame_id: str) -> Path:
        """Return the path velodyne/<id>.bin."""
        return self.folder / "velodyne" / f"{frame_id}.bin"

    def calib_path(self, frame_id: str) -> Path:
        """Return the path calib/<id>.txt."""
        return self.folder / "calib" / f"{frame_id}.txt"

    def label_path(self, frame_id: str) -> Path:
        """Return the path label_2/<id>.txt."""
        return self.folder / "label_2" / f"{frame_id}.txt"

    def image_path(self, frame_id: str) -> Path:
        """Return the path image_2/<id>.png, which need not exist."""
        return self.folder / "image_2" / f"{frame_id}.png"

    def calibration(self, frame_id: str) -> Calibration:
        """Read the frame's calibration; DatasetError if it is missing or damaged."""
        return read_calibration(self.calib_path(frame_id))

    def objects(self, frame_id: str) -> list[KittiObject]:
        """Read the frame's labels, including DontCare areas; DatasetError if they are missing or damaged."""
        return read_labels(self.label_path(frame_id))

    def image_size_wh(self, frame_id: str) -> tuple[int, int]:
        """Return width and height of the frame's image in pixels; KITTI's most common size without an image.

        Raises:
            DatasetError: the image is not a PNG: labels would be cropped by a wrong size.
        """
        path = self.image_path(frame_id)
        try:
            require_content(path, DatasetError)
            with path.open("rb") as file:
                start = file.read(24)
        except FileNotFoundError:
            return DEFAULT_IMAGE_SIZE_WH
        except OSError as error:
            raise DatasetError(f"{path}: cannot be read ({error.strerror}); replace or remove it") from None
        if len(start) < 24 or not start.startswith(_PNG) or min(size := struct.unpack(">2I", start[16:])) == 0:
            raise DatasetError(
                f"{path}: not a PNG, or damaged; replace it, or remove it: without images KITTI's size is taken"
            )
        return size[0], size[1]

    def input_paths(self, frame_id: str) -> tuple[Path, ...]:
        """Return the paths of scan, labels and calibration."""
        return self.scan_path(frame_id), self.label_path(frame_id), self.calib_path(frame_id)

    def require_files(self) -> None:
        """Raise DatasetError unless every frame has a calibration and labels."""
        paths = [path(frame_id) for path in (self.calib_path, self.label_path) for frame_id in self.frame_ids]
        if missing := [path for path in paths if not path.exists()]:
            raise DatasetError(
                f"{missing[0]}: not there ({len(missing)} of {len(paths)} calibration and label files of '{self.name}' "
                "are missing); every frame needs both, a label file may be empty"
            )

    @property
    def to_sensor(self) -> FrameChange:
        """Identity: scans are in the sensor's frame."""
        return FrameChange.turn(0.0)

    def points(self, frame_id: str, *, camera_view: bool) -> NDArray[np.float32]:
        """Read the points (N, 4) of the scan, LiDAR frame; with `camera_view` those within the camera image."""
        points = read_scan(self.scan_path(frame_id)).points
        if camera_view:
            points = points[in_image(points, self.calibration(frame_id), self.image_size_wh(frame_id))]
        return points

    def in_labeled_view(self, frame_id: str, positions: NDArray[np.float32]) -> NDArray[np.bool_]:
        """Return (N,) True for all of the positions."""
        return np.ones(len(positions), bool)

    def stored_points(self, frame_id: str) -> NDArray[np.float32]:
        """Read (N, 4) x, y, z in metres, LiDAR frame, and reflectance, as stored."""
        return stored_points(self.scan_path(frame_id), columns=None)

    def points_state(self, frame_id: str) -> tuple[int, ...]:
        """Return the size of the image, and size and time of scan and calibration."""
        states = [path.stat() for path in (self.scan_path(frame_id), self.calib_path(frame_id))]
        numbers = [number for state in states for number in (state.st_size, state.st_mtime_ns)]
        return (*self.image_size_wh(frame_id), *numbers)

    def label_types(self, frame_id: str) -> list[str]:
        """Return the type of every label, including DontCare."""
        return [item.type for item in self.objects(frame_id)]

    def label_yaws(self, frame_id: str) -> NDArray[np.float64]:
        """Return the rotation_y (M,) in radians of every object with a 3D box."""
        return np.array([item.rotation_y for item in objects_3d(self.objects(frame_id))])

    def labeled_boxes(self, frame_id: str, types: Container[str] | None = None) -> LabeledBoxes:
        """Return the frame's boxes in the LiDAR frame: those of `types`, or all that have a 3D box.

        Raises:
            DatasetError: missing or damaged labels or calibration; an object of `types` without a 3D box.
        """
        calibration = self.calibration(frame_id)
        objects = self.objects(frame_id)
        chosen = objects_3d(objects) if types is None else [item for item in objects if item.type in types]
        if flat := [item.type for item in chosen if not item.has_box_3d]:
            raise DatasetError(
                f"{self.label_path(frame_id)}: a {flat[0]} has no 3D box, its sizes are not all positive; "
                "complete the line, or make it DontCare"
            )
        return LabeledBoxes(boxes_from_objects(chosen, calibration), tuple(item.type for item in chosen))


def write_image_set(root: str | Path, name: str, frame_ids: Iterable[str]) -> None:
    """Write ImageSets/<name>.txt, one frame id per line."""
    with atomic_path(Path(root) / "ImageSets" / f"{name}.txt") as temporary:
        temporary.write_text("".join(f"{frame_id}\n" for frame_id in frame_ids), encoding="utf-8")


def read_image_set(root: Path, name: str) -> set[str]:
    """Read the frame ids in ImageSets/<name>.txt.

    Raises:
        DatasetError: there is no such list, or it is empty or not text.
    """
    path = root / "ImageSets" / f"{name}.txt"
    try:
        frame_ids = {line.strip() for line in read_text(path, DatasetError).splitlines()} - {""}
    except UnicodeDecodeError:
        raise DatasetError(f"{path}: not UTF-8 text; write one frame id per line") from None
    except OSError as error:
        names = ", ".join(p.stem for p in visible_files(path.parent, "*.txt")) or "none"
        raise DatasetError(
            f"{path}: no such split (lists there: {names}); write the list, one frame id per line (KITTI's own: asca "
            "prepare --kitti-split), or take every frame: --split training; in a configuration data.train_set and "
            "data.val_set = training"
        ) from error
    if not frame_ids:
        raise DatasetError(f"{path}: the list is empty; write one frame id per line")
    return frame_ids


FRAMES = 7481
_IN_TRAIN = (
    "k$&PPs$NsbpYgw$-AD1&bf)e$z8Lt#LZ;(hSi;-~^pQNLi@BmsCNgr2LK%|?mH>u0<>B*fK(6y3IiOBaYPMT=mdrFK`ta{Jz{eHF(q4z@+Q;QZ"
    "SMi!HGn7}jA<g}50Eceg`6d<Y`+&2#uWDmWN5peAq={-4{@g&xkLu0H-hkodJSj$nYM??P4bJlf;tcHh85Kf-prU{ew4{Cq+5dqp4JPaKF+%D7"
    "#%pe9iBH<v`8qzi=97?m9gAyHxh#NFN!lx_k80gj4ev*}sR$UHv+<a1(`8W4%NBW*Ht%&{NaJZRQ<ppbU?DJ{UVOKN8sZm0siVQc6&?13n5ppQ"
    "EhbI{{yZrgtf#jezDF}2=}eX1azwz!Mb3Ja69=-`msAco^X$Yk9$nm!|B&rgq#E`)1;W>H!xXX|+y(OMl%+B2I@^mm&~3;o5FWJyDI)Uz%abvL"
    "*Tl9kds@%nD}Zpe((_!sCa4AN4K|7(&+RA;%urd5mtI|H$yM~IITf~=)S&HJ#?2`bHeST9n`bX}Q57V^&zj6B@LKPmf`A99kx%X$dkEbI20UKs"
    "HV*D>7|&_+cmFaiP-qY8vdQA`#|QkTWbJ+r#HYuuiRYbCCH2M2zV&BW94W<#tH)*Ko|W~Jma$)T1`m736&o(<H(H9OQy{Pr2NdxE2Vno8=h&F="
    "S9*;MX8h?B2*Qe7q@EP9KSmk8HZg?!z!`{U)m6Dq2#I<2vOERx;<MZtS)%ms2Gv;=b_SP&K1d*kkbx1@gcml&8$9HCbjUflZtVxaW{<jJTr1f$"
    "B-lfgP5o+-gqK*WS5Z5V93==H*!r<Q5_&=_p@dXnFxb8MiOG`{u65>yR<{pgB#Rgrss3pui<tlO`uxb-q7%c85|q5(ywB@pRUTk@!!beU58DpB"
    "j8BtAb2Dnb#zPzOE@BSbOaHtLmni4K%ib^aFMG6#vEqmji0aQ{ZHt!K7t)Inen6CfRglEV=z0{*!HC;$R#&P!J&ncJTJ7UKbf4ad1zdlzpF@}7"
    "#4>|*2cwpU=#DlIf)U~UF$slh9*06RfVJ|aD;*fsBgf(16A`YCM@i7x@LKo|X`!1g1QJ7#no(q8P4hFRkW|$clCFZqo7-O;HHKGfk?C4#L~Otr"
    "&N6DER01y6`D$CjPaD~RH5BjM5>%_HEmZPRjtFK2<aq4Jk1QxYcdRfv;fjJ_U4mL0TtTS-"
)
"""One bit per frame, first frame and highest bit first, in base85: 1 for the list `train`."""


def train_val_frames() -> dict[str, list[str]]:
    """Return the frame ids of the lists `train` and `val`, in ascending order."""
    in_train = np.unpackbits(np.frombuffer(base64.b85decode(_IN_TRAIN), np.uint8))[:FRAMES].astype(bool)
    lists = {"train": np.flatnonzero(in_train), "val": np.flatnonzero(~in_train)}
    return {name: [f"{number:06d}" for number in numbers] for name, numbers in lists.items()}


def write_train_val_lists(root: Path) -> list[Path]:
    """Write ImageSets/train.txt and val.txt of KITTI's frames below `root`; lists that are there already stay.

    Returns:
        The files that were written.

    Raises:
        DatasetError: training/velodyne does not hold KITTI's 7,481 scans.
        OutputError: a list with other frames is there.
    """
    lists = train_val_frames()
    scans = {path.stem for path in visible_files(root / "training" / "velodyne", "*.bin")}
    listed = {frame_id for frame_ids in lists.values() for frame_id in frame_ids}
    if scans != listed:
        raise DatasetError(
            f"{root / 'training' / 'velodyne'}: {len(listed & scans)} of KITTI's {FRAMES} scans are there and "
            f"{len(scans - listed)} others; KITTI's lists are for all of its scans and no others: leave --kitti-split "
            "out, and write lists of your own"
        )
    missing = []
    for name, frame_ids in lists.items():
        path = root / "ImageSets" / f"{name}.txt"
        if not path.exists():
            missing.append(path)
        elif path.read_text(encoding="utf-8", errors="replace").split() != frame_ids:
            raise OutputError(
                f"{path}: lists other frames than KITTI's split; move it away, or leave --kitti-split out"
            )
    for path in missing:
        write_image_set(root, path.stem, lists[path.stem])
    return missing
