"""The files that `asca detect` writes: boxes of each scan and of the whole run, pictures, KITTI text."""

import json
from collections import Counter
from collections.abc import Collection, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import asdict
from pathlib import Path, PurePath
from types import TracebackType
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

from asca_deploy.scan_detections import ScanDetections
from asca_deploy.tracker import Tracks
from asca_pillars.base.errors import AscaError, DatasetError
from asca_pillars.base.files import atomic_path, require_content, write_json, write_text
from asca_pillars.base.locks import recover
from asca_pillars.base.own_files import (
    Recognizer,
    ending_with,
    is_own_picture,
    json_lines,
    json_object,
    page_end,
    require_no_link,
    require_own,
    require_own_file,
)
from asca_pillars.data.boxes.detector_scope import DetectorScope
from asca_pillars.data.kitti import Calibration, calibration_of_scan, is_detection_text, read_calibration
from asca_pillars.data.open_split import labels_of_scan
from asca_pillars.geometry.overlap import bev_iou
from asca_pillars.pictures.drawing import Image
from asca_pillars.pictures.gallery_page import GalleryCard, gallery_page
from asca_pillars.pictures.visualize import draw_on_image, read_image, write_png
from asca_pillars.scans.scan_reader import Scan

COMMAND = "asca detect"
RUN_FILE = "detections.jsonl"
ABOUT_FILE = "recording.json"
KITTI_FILE = "tracks.txt"
UNREADABLE_FILE = "unreadable.jsonl"
INDEX_FILE = "index.html"
MISSED_IOU = 0.1
"""BEV IoU below which a label counts as missed on the page of pictures."""


def _is_kitti_text(path: Path) -> bool:
    return is_detection_text(path.read_text(encoding="utf-8", errors="replace"))


def _is_tracking_text(path: Path) -> bool:
    with path.open(encoding="utf-8", errors="replace") as file:
        frame, _, rest = file.readline().partition(" ")
    track, _, label = rest.partition(" ")
    return frame.isdecimal() and track.removeprefix("-").isdecimal() and is_detection_text(label)


_IS_RUN = json_lines("scan", "boxes", "points_not_finite")
_COMPANIONS: dict[str, Recognizer] = {
    ABOUT_FILE: json_object("recording", "files", "topic", "model", "runs_on"),
    KITTI_FILE: _is_tracking_text,
    UNREADABLE_FILE: json_lines("error", "scan"),
    INDEX_FILE: ending_with(page_end(COMMAND)),
}
"""Files that other kinds of runs write beside RUN_FILE, about the same scans."""
_OF_A_SCAN: dict[str, Recognizer] = {
    ".json": json_object("scan", "frame", "boxes", "points_not_finite"),
    ".txt": _is_kitti_text,
    "_bev.png": is_own_picture,
    "_image.png": is_own_picture,
}
"""Files of a single scan, by the endings of their names."""


def require_own_results(
    out: Path, markers: Mapping[str, Recognizer] | None = None, written: Collection[str] = ()
) -> None:
    """Make sure that `asca detect` may write into `out`: it is absent, empty, or that of an earlier run.

    Args:
        out: the folder.
        markers: other files than RUN_FILE that show it, by their paths in it.
        written: names of files of single scans, which have their own check.

    Raises:
        OutputError: names what is not ours to replace.
    """
    require_own(out, COMMAND, {RUN_FILE: _IS_RUN, **(markers or {})})
    for name, is_own in _COMPANIONS.items():
        if name not in written:
            require_own_file(out / name, COMMAND, is_own)


def remove_companions(out: Path, written: Collection[str]) -> None:
    """Remove what an earlier run wrote beside its RUN_FILE, now that another one is there; not what was `written`."""
    for name, is_own in _COMPANIONS.items():
        if name not in written and (out / name).exists():
            require_own_file(out / name, COMMAND, is_own)
            (out / name).unlink()


class ResultWriter:
    """Writes the results of scan after scan to a folder; `detections.jsonl` appears when the block ends well.

    With pictures there is a page of them, index.html.

    Args:
        out: the folder: absent, empty, or that of an earlier run. Results of other scans in it stay.
        names: of the scans' results, paths below `out` without endings.
        pictures: False writes no picture.
        scope: what the detector could find.

    Raises:
        OutputError: when the block is entered, if something else would be replaced.
    """

    def __init__(self, out: Path, names: Sequence[Path], *, pictures: bool, scope: DetectorScope) -> None:
        self.out, self._names, self._pictures, self._scope = out, names, pictures, scope
        self._cards: list[GalleryCard] = []
        self._all_kept = True
        self._stack = ExitStack()
        self._written: set[str] = set()
        self._lines: IO[str] | None = None
        self.remarks: list[str] = []
        """Messages for the user on what could not be drawn or written."""

    def __enter__(self) -> "ResultWriter":
        self._written = {f"{name.as_posix()}{ending}" for name in self._names for ending in _OF_A_SCAN}
        require_own_results(self.out, written=self._written)
        for folder in {name.parent for name in self._names}:
            require_no_link(self.out, folder)
            recover(self.out / folder)
        for name in self._names:
            for ending, is_own in _OF_A_SCAN.items():
                require_own_file(self._named(name, ending), COMMAND, is_own)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._stack.__exit__(kind, error, trace)
        if kind is None and self._lines is not None:
            if self._cards:
                write_text(self.out / INDEX_FILE, self._page())
            if self._cards or self._all_kept:
                self._written.add(INDEX_FILE)
            remove_companions(self.out, self._written)

    def __call__(
        self,
        path: Path,
        name: Path,
        scan: Scan,
        detections: ScanDetections,
        tracks: Tracks | None = None,
        time_ns: int | None = None,
    ) -> None:
        """Write NAME.json and NAME_bev.png; with a KITTI calibration NAME.txt, with an image NAME_image.png too.

        Those of them that an earlier run wrote, and this one does not, are removed if the boxes are others now.
        `tracks` are of the same boxes; the time is written if it is given.
        """
        if self._lines is None:
            self._lines = self._open()
        calibration = self._calibration(path)  # first: of several remarks a user sees the first one
        content = scan_content(path, scan, detections, self._scope)
        if tracks is not None:
            content["boxes"] = tracks.to_dicts()
        if time_ns is not None:
            content |= {"time_s": time_ns / 1e9, "time_ns": time_ns}
        line = as_line(content)
        kept = self._has_boxes(name, json.loads(line)["boxes"])
        self._all_kept &= kept
        write_json(self._named(name, ".json"), content)
        self._lines.write(line)
        written = {".json"}
        if self._pictures:
            labels = self._labels(path)
            write_png(self._named(name, "_bev.png"), detections.plot(scan.points, labels=labels))
            written.add("_bev.png")
            self._cards.append(_card(name, detections, labels, content["warnings"]))
        if calibration is not None:
            written |= self._write_camera_view(path, name, detections, calibration)
        for ending in () if kept else _OF_A_SCAN.keys() - written:
            self._named(name, ending).unlink(missing_ok=True)

    def _page(self) -> str:
        """Return the page of all pictures."""
        has_labels = any("missed" in card.values for card in self._cards)
        introduction = "Boxes seen from above, with their scores; ahead of the sensor is up."
        if has_labels:
            introduction += f"\n\nLabels are white; missed ones overlap no box by {MISSED_IOU:g} (IoU from above)."
        title = f"{COMMAND}: {len(self._cards)} scan{'s' if len(self._cards) != 1 else ''}"
        return gallery_page(title, introduction, self._cards, "missed" if has_labels else None, end=page_end(COMMAND))

    def _has_boxes(self, name: Path, boxes: list[dict[str, Any]]) -> bool:
        """Return whether the scan's JSON of an earlier run holds these boxes."""
        path = self._named(name, ".json")
        if not path.exists() or not path.stat().st_size:
            return False
        return bool(json.loads(path.read_text(encoding="utf-8"))["boxes"] == boxes)

    def _write_camera_view(
        self, path: Path, name: Path, detections: ScanDetections, calibration: Calibration
    ) -> set[str]:
        """Write the boxes that the camera sees as text, and draw them on its image; return the endings of the files."""
        image = self._image(path.parent.parent / "image_2" / f"{path.stem}.png")
        _write_kitti(self._named(name, ".txt"), detections, calibration, image)
        if image is not None and self._pictures:
            drawn = draw_on_image(image, detections.boxes, detections.names, detections.scores, calibration)
            write_png(self._named(name, "_image.png"), drawn)
            return {".txt", "_image.png"}
        return {".txt"}

    def _calibration(self, path: Path) -> Calibration | None:
        calib_path = calibration_of_scan(path)
        if calib_path is None:
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
            return labels_of_scan(path)
        except AscaError as error:
            self.remarks.append(f"labels are not drawn: {error}")
            return None

    def _open(self) -> IO[str]:
        if not (self.out / RUN_FILE).exists():
            write_text(self.out / RUN_FILE, "")  # marks the folder, so that a run that was killed can be given again
        temporary = self._stack.enter_context(atomic_path(self.out / RUN_FILE))
        return self._stack.enter_context(temporary.open("w", encoding="utf-8"))

    def _named(self, name: Path, ending: str) -> Path:
        # Not with_suffix: a name may hold dots of its own.
        return self.out / name.with_name(name.name + ending)


def _card(
    name: Path, detections: ScanDetections, labels: NDArray[np.floating] | None, warnings: Sequence[str]
) -> GalleryCard:
    """Make the card of a scan on the page of pictures; `labels` are boxes (M, 7) in its frame."""
    values: dict[str, float] = {"boxes": len(detections)}
    if len(detections):
        values |= {"best score": float(detections.scores.max()), "lowest score": float(detections.scores.min())}
    if labels is not None:
        level = labels if detections.level is None else detections.level.boxes(labels)
        seen = labels[detections.ranges.hold_centers(level)]
        overlaps = bev_iou(seen.astype(np.float64), detections.boxes.astype(np.float64))
        values["missed"] = int((overlaps.max(axis=1, initial=0.0) < MISSED_IOU).sum())
    picture = PurePath(name.with_name(name.name + "_bev.png"))
    return GalleryCard(name.as_posix(), picture, values, Counter(detections.names), warnings)


def _write_kitti(path: Path, detections: ScanDetections, calibration: Calibration, image: Any) -> None:
    """Write the detections in the camera's image in KITTI's format, whose tools take no others."""
    size_wh = None if image is None else (image.shape[1], image.shape[0])
    write_text(path, detections.to_kitti(calibration, size_wh))


def as_line(content: dict[str, Any]) -> str:
    """Return a line of `detections.jsonl`, with its end."""
    return json.dumps(content) + "\n"


def scan_content(path: Path, scan: Scan, detections: ScanDetections, scope: DetectorScope) -> dict[str, Any]:
    """Return the content of one scan as plain values; `path` names it, `scope` is the detector's."""
    report, notes = detections.report, scan.notes
    return {
        "scan": str(path),
        "frame": "that of the scan; box centers; yaw about z, from x towards y",
        "boxes": detections.to_dicts(),
        "detector": scope.to_json(),
        "made_by": dict(detections.made_by),
        **asdict(report.counts),
        "passes": report.passes,
        "points_not_finite": report.non_finite_points + notes.dropped_points,
        "reflectance_scale": notes.reflectance_scale,
        "reflectances_clipped": report.clipped_reflectances + notes.clipped_reflectances,
        "outputs_not_finite": report.non_finite_outputs,
        "warnings": [*notes.remarks, *report.warnings],
    }
