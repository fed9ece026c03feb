"""The worst frames as pictures: what was missed and what was seen where nothing is, from above and on the image."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from rich.console import Console
from rich.progress import track

from asca_pillars.data.kitti import Calibration, KittiObject, KittiSplit, boxes_from_objects, in_image, read_labels
from asca_pillars.data.scans.scan_reader import read_scan
from asca_pillars.evaluation.kitti.score_threshold import ScoreMatches
from asca_pillars.files import atomic_path, portable_name
from asca_pillars.geometry.ranges import Ranges
from asca_pillars.pictures.drawing import Color, Image
from asca_pillars.pictures.visualize import BoxLayer, draw_layers, draw_on_image, read_image, write_png

INDEX = "index.md"
_INTRODUCTION = """# {title}: worst frames

The frames with most misses and false detections at the fixed score, by KITTI's moderate difficulty. A false detection
may well stand on an object: to find it, its 3D overlap must exceed 0.7 for cars and 0.5 for the others. Objects beyond
the difficulty's limits are not counted, and what only touches them or DontCare areas is ignored.
"""


@dataclass(frozen=True)
class _Kind:
    """Boxes of one outcome: whose they are, how they look, and what is written beside them."""

    title: str
    color: Color
    text: str
    thickness_px: int


# Most important first: what is on top in the picture and first in its legend.
_MISSED = _Kind("missed", (70, 70, 255), "missed {type}", 5)
_FALSE = _Kind("false", (255, 110, 255), "{type} {score:.2f}", 5)
_FOUND = _Kind("found", (255, 255, 255), "", 2)
_TRUE = _Kind("true", (90, 230, 90), "", 6)
_NOT_COUNTED = _Kind("not counted", (150, 150, 150), "", 2)
_IGNORED = _Kind("ignored", (200, 160, 60), "", 3)


def worst_frames(frames: Sequence[ScoreMatches], count: int) -> list[ScoreMatches]:
    """The `count` frames with most misses and false detections, worst first; frames without any are left out."""
    wrong = [frame for frame in frames if frame.errors]
    return sorted(wrong, key=lambda frame: (-frame.errors, frame.frame_id))[:count]


def write_gallery(
    folder: str | Path,
    frames: Sequence[ScoreMatches],
    split: KittiSplit,
    labels: str | Path,
    predictions: str | Path,
    ranges: Ranges,
    title: str,
    *,
    console: Console | None = None,
) -> None:
    """Draw frames: RANK_FRAME.png each, and index.md that lists them.

    Args:
        folder: for the pictures.
        frames: their matches, in the order in which the pictures are numbered.
        split: the scans, calibrations and images.
        labels, predictions: the folders of KITTI text that were judged.
        ranges: what the pictures show.
        title: what was evaluated, for index.md.
        console: shows the progress.

    Raises:
        DatasetError, ScanError: a frame's scan, calibration or text cannot be read.
    """
    rows = [_INTRODUCTION.format(title=title), "| frame | missed | false |", "| --- | ---: | ---: |"]
    bar = track(frames, "Drawing", console=console, disable=console is None)
    for rank, frame in enumerate(bar, start=1):
        name = f"{portable_name(f'{rank:03d}_{frame.frame_id}')}.png"
        write_png(Path(folder) / name, _draw(frame, split, Path(labels), Path(predictions), ranges))
        rows.append(f"| [{frame.frame_id}]({name}) | {frame.missed.sum()} | {frame.false_positive.sum()} |")
    with atomic_path(Path(folder) / INDEX) as temporary:
        temporary.write_text("\n".join([*rows, ""]), encoding="utf-8")


def _draw(frame: ScoreMatches, split: KittiSplit, labels: Path, predictions: Path, ranges: Ranges) -> Image:
    frame_id = frame.frame_id
    calibration = split.calibration(frame_id)
    points = read_scan(split.scan_path(frame_id)).points
    points = points[in_image(points, calibration, split.image_size_wh(frame_id))]
    truth, found = (read_labels(folder / f"{frame_id}.txt") for folder in (labels, predictions))
    layers = [
        _layer(_MISSED, truth, frame.missed, calibration),
        _layer(_FALSE, found, frame.false_positive, calibration),
        _layer(_FOUND, truth, frame.found, calibration),
        _layer(_TRUE, found, frame.true_positive, calibration),
        _layer(_NOT_COUNTED, truth, frame.not_counted, calibration),
        _layer(_IGNORED, found, frame.ignored, calibration),
    ]
    picture = draw_layers(points, layers, ranges)
    image = read_image(split.image_path(frame_id))
    return picture if image is None else _below(picture, _draw_on(image, layers, calibration))


def _layer(
    kind: _Kind, objects: Sequence[KittiObject], chosen: NDArray[np.bool_], calibration: Calibration
) -> BoxLayer:
    own = [item for item, is_chosen in zip(objects, chosen, strict=True) if is_chosen and item.has_box_3d]
    texts = [kind.text.format(type=item.type, score=item.score or 0.0) for item in own] if kind.text else ()
    return BoxLayer(kind.title, boxes_from_objects(own, calibration), kind.color, texts, kind.thickness_px)


def _draw_on(image: Image, layers: Sequence[BoxLayer], calibration: Calibration) -> Image:
    boxes = np.concatenate([layer.boxes for layer in layers])
    texts = [text for layer in layers for text in layer.texts or [""] * len(layer.boxes)]
    colors = [layer.color for layer in layers for _ in layer.boxes]
    return draw_on_image(image, boxes, texts, None, calibration, colors=colors)


def _below(picture: Image, image: Image) -> Image:
    """The image under the picture, as wide as that."""
    width = picture.shape[1]
    height = round(image.shape[0] * width / image.shape[1])
    return np.vstack([picture, cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA)]).astype(np.uint8)
