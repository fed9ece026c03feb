"""The files that `asca detect` writes: boxes of each scan and of the whole run, pictures, KITTI text."""

import json
from contextlib import ExitStack
from dataclasses import asdict
from pathlib import Path
from types import TracebackType
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

from asca_deploy import Detections
from asca_pillars.data.kitti import Calibration, read_calibration
from asca_pillars.data.labels_beside import labels_beside
from asca_pillars.data.scans.scan_reader import Scan
from asca_pillars.errors import AscaError, DatasetError
from asca_pillars.files import atomic_path, require_own, write_json
from asca_pillars.input_files import require_content
from asca_pillars.pictures.drawing import Image
from asca_pillars.pictures.visualize import draw_on_image, read_image, write_png

RUN_FILE = "detections.jsonl"
RUN_MARK = '"scan": '  # in each of its lines


class ResultWriter:
    """Writes the results of scan after scan to a folder; `detections.jsonl` appears when the block ends well.

    Args:
        out: the folder: absent, empty, or that of an earlier run. Results of other scans in it stay.
        pictures: False writes no picture.

    Raises:
        OutputError: when the block is entered, if `out` holds files of something else.
    """

    def __init__(self, out: Path, *, pictures: bool) -> None:
        self.out, self._pictures = out, pictures
        self._stack = ExitStack()
        self._lines: IO[str] | None = None
        self.remarks: list[str] = []
        """What could not be drawn or written, and why; for the user."""

    def __enter__(self) -> "ResultWriter":
        require_own(self.out, "asca detect", RUN_FILE, text=RUN_MARK)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._stack.__exit__(kind, error, trace)

    def __call__(self, path: Path, name: Path, scan: Scan, detections: Detections) -> None:
        """NAME.json and NAME_bev.png; with a KITTI calibration NAME.txt, with an image NAME_image.png too."""
        if self._lines is None:
            self._lines = self._open()
        calibration = self._calibration(path)  # first: of several remarks a user sees the first one
        content = scan_content(path, scan, detections)
        write_json(self._named(name, ".json"), content)
        self._lines.write(as_line(content))
        if self._pictures:
            write_png(self._named(name, "_bev.png"), detections.plot(scan.points, labels=self._labels(path)))
        if calibration is None:
            return
        image = self._image(path.parent.parent / "image_2" / f"{path.stem}.png")
        _write_kitti(self._named(name, ".txt"), detections, calibration, image)
        if image is not None and self._pictures:
            drawn = draw_on_image(image, detections.boxes, detections.names, detections.scores, calibration)
            write_png(self._named(name, "_image.png"), drawn)

    def _calibration(self, path: Path) -> Calibration | None:
        calib_path = path.parent.parent / "calib" / f"{path.stem}.txt"
        if path.parent.name != "velodyne" or not calib_path.exists():
            return None
        try:
            return read_calibration(calib_path)
        except AscaError as error:
            self.remarks.append(f"no KITTI text is written: {error}")
            return None

    def _image(self, path: Path) -> Image | None:
        try:
            require_content(path, DatasetError)
        except (AscaError, OSError) as error:
            self.remarks.append(f"the boxes are not drawn on the image: {error}")
            return None
        image = read_image(path)
        if image is None and path.exists():
            self.remarks.append(f"{path}: cannot be read as an image; the boxes are not drawn on it")
        return image

    def _labels(self, path: Path) -> NDArray[np.float32] | None:
        try:
            return labels_beside(path)
        except AscaError as error:
            self.remarks.append(f"labels are not drawn: {error}")
            return None

    def _open(self) -> IO[str]:
        if not (self.out / RUN_FILE).exists():
            with atomic_path(self.out / RUN_FILE):
                pass  # marks the folder from the start, so that a run that was killed can be given again
        temporary = self._stack.enter_context(atomic_path(self.out / RUN_FILE))
        return self._stack.enter_context(temporary.open("w", encoding="utf-8"))

    def _named(self, name: Path, ending: str) -> Path:
        # Not with_suffix: a name may hold dots of its own.
        return self.out / name.with_name(name.name + ending)


def _write_kitti(path: Path, detections: Detections, calibration: Calibration, image: Any) -> None:
    """What the camera sees, as KITTI's tools want it: they know no boxes outside the image."""
    size_wh = None if image is None else (image.shape[1], image.shape[0])
    with atomic_path(path) as temporary:
        temporary.write_text(detections.to_kitti(calibration, size_wh), encoding="utf-8")


def as_line(content: dict[str, Any]) -> str:
    """A line of `detections.jsonl`, with its end."""
    return json.dumps(content) + "\n"


def scan_content(path: Path, scan: Scan, detections: Detections) -> dict[str, Any]:
    """What is written of one scan, as plain values; `path` names it."""
    report, notes = detections.report, scan.notes
    return {
        "scan": str(path),
        "frame": "that of the scan; box centers; yaw about z, from x towards y",
        "boxes": detections.to_dicts(),
        **asdict(report.counts),
        "passes": report.passes,
        "points_not_finite": report.non_finite_points + notes.dropped_points,
        "reflectance_scale": notes.reflectance_scale,
        "reflectances_clipped": report.clipped_reflectances + notes.clipped_reflectances,
        "outputs_not_finite": report.non_finite_outputs,
        "warnings": [*notes.remarks, *report.warnings],
    }
