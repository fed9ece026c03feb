"""Output files of `asca eval`: a page of tables, its JSON, the predictions of its own run, and a gallery.

The gallery has pictures of frames with missed objects and false positives, from above and on the image. The worst
frames of one detector, or for two those in which they differ most, side by side.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path, PurePath
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from asca_pillars.base.errors import OutputError
from asca_pillars.base.files import portable_name, remove_directory, require_writable, write_json, write_text
from asca_pillars.base.own_files import (
    Recognizer,
    ending_with,
    is_own_picture,
    json_object,
    page_end,
    require_not_input,
    require_own,
    require_own_file,
    require_replaceable,
)
from asca_pillars.base.progress import SILENT, Reporter
from asca_pillars.data.kitti import Calibration, KittiObject, KittiSplit, boxes_from_objects, in_image, read_labels
from asca_pillars.evaluation.errors.error_report import PRODUCTS as ERROR_PRODUCTS
from asca_pillars.evaluation.errors.error_report import remove_errors
from asca_pillars.evaluation.kitti.score_threshold import ScoreMatches
from asca_pillars.evaluation.report_page import ReportPage
from asca_pillars.geometry.boxes import Ranges
from asca_pillars.pictures.drawing import BACKGROUND, BoxLayer, Color, Image, Texts
from asca_pillars.pictures.gallery_page import GalleryCard, gallery_page
from asca_pillars.pictures.visualize import draw_layers, draw_on_image, read_image, write_png
from asca_pillars.scans.scan_reader import read_scan

INDEX = "index.html"
INDEX_END = page_end("asca eval")
_INTRODUCTION = """{chosen}

A false detection may well stand on an object: to find it, its 3D overlap must exceed 0.7 for cars and 0.5 for the
others. Objects beyond the difficulty's limits are not counted, and what only touches them or DontCare areas is ignored.
"""
_WORST = {
    "which": "worst frames",
    "chosen": "The frames with most misses and false detections at the fixed score, by KITTI's moderate difficulty.",
}
_DIFFERENT = {
    "which": "where they differ most",
    "chosen": "The frames with most objects that only one of the two finds, and the largest difference of false\n"
    "detections, each at its fixed score, by KITTI's moderate difficulty.",
}
_HEADING_PX = 34


@dataclass(frozen=True)
class _Kind:
    """Outcome of boxes with their source, style and caption."""

    title: str
    color: Color
    text: str
    thickness_px: int


# Most important first: on top in the picture and first in its legend.
_MISSED = _Kind("missed", (70, 70, 255), "missed {type}", 5)
_FALSE = _Kind("false", (255, 110, 255), "{type} {score:.2f}", 5)
_FOUND = _Kind("found", (255, 255, 255), "", 2)
_TRUE = _Kind("true", (90, 230, 90), "", 6)
_NOT_COUNTED = _Kind("not counted", (150, 150, 150), "", 2)
_IGNORED = _Kind("ignored", (200, 160, 60), "", 3)


Matches = Sequence[ScoreMatches]


@dataclass(frozen=True)
class EvaluatedDetector:
    """Detector: its name, the folder of its predictions as KITTI text, and their matches with the labels."""

    name: str
    predictions: Path
    frames: Matches


def worst_frames(frames: Sequence[ScoreMatches], count: int) -> list[ScoreMatches]:
    """Return the `count` frames with most misses and false positives, worst first; frames without any are left out."""
    wrong = [frame for frame in frames if frame.errors]
    return sorted(wrong, key=lambda frame: (-frame.errors, frame.frame_id))[:count]


def most_different_frames(first: Matches, second: Matches, count: int) -> list[tuple[ScoreMatches, ScoreMatches]]:
    """Return the matches of two detectors in the `count` frames in which they differ most, most different first.

    Frames that one of them lacks, and those without differences, are left out.
    """
    by_id = {frame.frame_id: frame for frame in second}
    pairs = [(frame, by_id[frame.frame_id]) for frame in first if frame.frame_id in by_id]
    different = [pair for pair in pairs if _difference(*pair)]
    return sorted(different, key=lambda pair: (-_difference(*pair), pair[0].frame_id))[:count]


def _difference(first: ScoreMatches, second: ScoreMatches) -> int:
    """Return the number of objects found by only one of the two, plus the difference of their false positives."""
    found_once = np.logical_xor(first.found, second.found).sum()
    return int(found_once) + abs(int(first.false_positive.sum()) - int(second.false_positive.sum()))


def write_gallery(
    folder: str | Path,
    detectors: Sequence[EvaluatedDetector],
    count: int,
    split: KittiSplit,
    labels: str | Path,
    ranges: Ranges,
    *,
    reporter: Reporter = SILENT,
) -> None:
    """Draw frames: RANK_FRAME.png each, and index.html that shows them.

    Args:
        folder: for the pictures.
        detectors: one, whose worst frames are drawn, or two, of which the frames that differ most are.
        count: largest number of frames.
        split: the scans, calibrations and images.
        labels: folder of KITTI text with the labels.
        ranges: ranges of the pictures.
        reporter: for the progress.

    Raises:
        DatasetError, ScanError: a frame's scan, calibration or text cannot be read.
    """
    if len(detectors) == 1:
        chosen: list[tuple[ScoreMatches, ...]] = [(frame,) for frame in worst_frames(detectors[0].frames, count)]
        words, kinds = _WORST, [("missed", "false")]
    else:
        first, second = detectors
        chosen = [*most_different_frames(first.frames, second.frames, count)]
        words, kinds = _DIFFERENT, [(f"missed, {detector.name}", f"false, {detector.name}") for detector in detectors]
    title = " and ".join(detector.name for detector in detectors)
    cards = []
    bar = reporter.track(chosen, "Drawing")
    for rank, matches in enumerate(bar, start=1):
        frame_id = matches[0].frame_id
        name = f"{portable_name(f'{rank:03d}_{frame_id}')}.png"
        write_png(Path(folder) / name, _draw(matches, detectors, split, Path(labels), ranges))
        values: dict[str, float] = {}
        if len(matches) == 1:
            values["errors"] = matches[0].errors
        else:
            values["difference"] = _difference(*matches)
        for (missed, false), match in zip(kinds, matches, strict=True):
            values |= {missed: int(match.missed.sum()), false: int(match.false_positive.sum())}
        cards.append(GalleryCard(frame_id, PurePath(name), values))
    page = gallery_page(f"{title}: {words['which']}", _INTRODUCTION.format(**words), cards, None, end=INDEX_END)
    write_text(Path(folder) / INDEX, page)


def _draw(
    matches: Sequence[ScoreMatches],
    detectors: Sequence[EvaluatedDetector],
    split: KittiSplit,
    labels: Path,
    ranges: Ranges,
) -> Image:
    frame_id = matches[0].frame_id
    calibration = split.calibration(frame_id)
    points = read_scan(split.scan_path(frame_id)).points
    points = points[in_image(points, calibration, split.image_size_wh(frame_id))]
    image = read_image(split.image_path(frame_id))
    truth = read_labels(labels / f"{frame_id}.txt")
    detections = [read_labels(detector.predictions / f"{frame_id}.txt") for detector in detectors]
    layers = [_layers(match, truth, own, calibration) for match, own in zip(matches, detections, strict=True)]
    every_box = np.concatenate([layer.boxes for own in layers for layer in own])
    panels = []
    for detector, own in zip(detectors, layers, strict=True):
        panel = draw_layers(points, own, ranges, room_for=every_box)
        if image is not None:
            panel = _below(panel, _draw_on(image, own, calibration))
        panels.append(panel if len(detectors) == 1 else _headed(panel, detector.name))
    return np.hstack(panels)


def _layers(
    frame: ScoreMatches, truth: Sequence[KittiObject], detections: Sequence[KittiObject], calibration: Calibration
) -> list[BoxLayer]:
    return [
        _layer(_MISSED, truth, frame.missed, calibration),
        _layer(_FALSE, detections, frame.false_positive, calibration),
        _layer(_FOUND, truth, frame.found, calibration),
        _layer(_TRUE, detections, frame.true_positive, calibration),
        _layer(_NOT_COUNTED, truth, frame.not_counted, calibration),
        _layer(_IGNORED, detections, frame.ignored, calibration),
    ]


def _headed(picture: Image, text: str) -> Image:
    """Return the picture below a line of text, truncated at its start if too long, with a border on the right."""
    bar = np.full((_HEADING_PX, picture.shape[1], 3), BACKGROUND, np.uint8)
    texts = Texts(bar, 0.6)
    while texts.size(text)[0] > picture.shape[1] - 32:
        text = f"...{text[4:]}"
    texts.put(text, [(16, _HEADING_PX - 11)], (255, 255, 255))
    headed = np.vstack([bar, picture])
    headed[:, -2:] = 90
    return headed.astype(np.uint8)


def _layer(
    kind: _Kind, objects: Sequence[KittiObject], chosen: NDArray[np.bool_], calibration: Calibration
) -> BoxLayer:
    boxed = [item for item, is_chosen in zip(objects, chosen, strict=True) if is_chosen and item.has_box_3d]
    texts = [kind.text.format(type=item.type, score=item.score or 0.0) for item in boxed] if kind.text else ()
    return BoxLayer(kind.title, boxes_from_objects(boxed, calibration), kind.color, texts, kind.thickness_px)


def _draw_on(image: Image, layers: Sequence[BoxLayer], calibration: Calibration) -> Image:
    boxes = np.concatenate([layer.boxes for layer in layers])
    texts = [text for layer in layers for text in layer.texts or [""] * len(layer.boxes)]
    colors = [layer.color for layer in layers for _ in layer.boxes]
    return draw_on_image(image, boxes, texts, None, calibration, colors=colors)


def _below(picture: Image, image: Image) -> Image:
    """Return the image below the picture, scaled to its width."""
    width = picture.shape[1]
    height = round(image.shape[0] * width / image.shape[1])
    return np.vstack([picture, cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA)]).astype(np.uint8)


COMMAND = "asca eval"
CURVES = "curves.png"
REPORTS = {
    "report": json_object("subject", "frames_asked", "results", "bands", "operating_points"),
    "waymo": json_object("subject", "frames_asked", "results", "means", protocol="waymo"),
    "iou": json_object("subject", "shortage", "iou", "at_score", protocol="iou"),
    "distance": json_object("subject", "shortage", "nuscenes", "at_score", protocol="distance"),
    "tracking": json_object("subject", "frames_found", "not_scored", "classes"),
}
"""Recognizer of the JSON of each report, by the name of its file."""
_PAGE_END = page_end(COMMAND)
_PRODUCTS: dict[str, Recognizer] = {
    **{f"{name}.json": is_own for name, is_own in REPORTS.items()},
    **{f"{name}.md": ending_with(_PAGE_END) for name in REPORTS},
    CURVES: is_own_picture,
    **ERROR_PRODUCTS,
}
MADE_BY = "made_by.json"
PREDICTIONS_FOLDER = (COMMAND, MADE_BY, json_object("model", "data", "split", "files"))
"""Command, marker and recognizer of the folder of a model's predictions, as for `atomic_directory`."""
GALLERY_FOLDER = (COMMAND, INDEX, ending_with(INDEX_END))
"""Command, marker and recognizer of the folder of pictures."""


def check_output_folder(
    name: str,
    out: Path,
    json_path: Path | None,
    predictions: Path | None,
    inputs: Iterable[str | Path | None],
) -> None:
    """Make sure that nothing but earlier evaluations is replaced, and none of the inputs.

    Args:
        name: name of the report, see REPORTS.
        out: output folder.
        json_path: path of a copy of the JSON; None for none.
        predictions: evaluated predictions, possibly those of an earlier evaluation in `out`; None: a model is run.
        inputs: other files that are read; None is ignored.

    Raises:
        OutputError, OSError: a file cannot be replaced; names it.
    """
    inputs = list(inputs)
    require_own(out, COMMAND, {**_PRODUCTS, f"predictions/{MADE_BY}": PREDICTIONS_FOLDER[2]})
    for folder, kind in (("predictions", PREDICTIONS_FOLDER), ("gallery", GALLERY_FOLDER)):
        require_replaceable(out / folder, *kind)
    for product in ("gallery", *_PRODUCTS):
        require_not_input(out / product, [predictions, *inputs])
    if predictions is None or not _is_within(predictions, out / "predictions"):  # that folder is removed or replaced
        require_not_input(out / "predictions", inputs)
    if json_path is not None:
        others = {(out / product).resolve() for product in _PRODUCTS} - {(out / f"{name}.json").resolve()}
        if json_path.resolve() in others:
            raise OutputError(f"{json_path}: another file of the evaluation has that name; choose another one")
    require_writable(json_path, COMMAND, REPORTS[name], [predictions, *inputs])


def write_report(
    name: str,
    page: ReportPage,
    content: dict[str, Any],
    out: Path,
    json_path: Path | None,
    scored: Path,
) -> None:
    """Write `name`.json and `name`.md below `out`, and the JSON to `json_path`, too.

    An earlier evaluation's analysis of errors is removed.

    Args:
        name: name of the files, see REPORTS.
        page: contents of the Markdown file.
        content: contents of the JSON file.
        out: output folder of the evaluation, see `check_output_folder`.
        json_path: None for no other copy.
        scored: evaluated predictions; those of an earlier evaluation in `out` are removed.

    Raises:
        OutputError, OSError: something cannot be written or removed.
    """
    _remove_predictions_of_another(out, scored)
    remove_errors(out)
    for path in (out / f"{name}.json", *([] if json_path is None else [json_path])):
        require_own_file(path, COMMAND, REPORTS[name])
        write_json(path, content)
    write_text(out / f"{name}.md", page.markdown() + _PAGE_END)


def _remove_predictions_of_another(out: Path, scored: Path) -> None:
    if not _is_within(scored, out / "predictions"):
        remove_directory(out / "predictions", *PREDICTIONS_FOLDER)


def _is_within(path: Path, folder: Path) -> bool:
    return folder.resolve() in (path.resolve(), *path.resolve().parents)
