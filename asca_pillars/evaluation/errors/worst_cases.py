"""Pictures (SVG) of the worst errors of each kind: false positives, missed objects and inaccurate boxes."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import groupby
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from asca_pillars.base.progress import SILENT, Reporter
from asca_pillars.data.insertion.ground_fit import Ground, fit_ground
from asca_pillars.evaluation.errors.box_errors import (
    BRIGHT_REFLECTANCE,
    RESIDUALS,
    DetectionMatch,
    ObjectMatch,
    Surroundings,
    box_residuals,
)
from asca_pillars.evaluation.errors.error_frames import ErrorFrames
from asca_pillars.evaluation.errors.error_summary import BLOCK_FRAMES, Matches, view_of
from asca_pillars.geometry.boxes import footprints

MAX_POINTS = 1200  # of a pane; more are subsampled
VIEW_TITLES = ("from above", "from the side", "from the sensor")
_LOW_M, _HIGH_M = -0.5, 3.3  # range of drawn heights
_GROUND_M = 0.15
_GAP_CM = 20
_Doubles = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class DrawnBox:
    """Box (7,), sensor at the origin, and its source; `main` is the subject of the picture."""

    box: _Doubles
    kind: Literal["label", "detection"]
    main: bool = False


@dataclass(frozen=True, eq=False)
class _Pane:
    """Points (N, 2) in metres, to the right and up, and outlines in the same axes.

    Attributes:
        low, high: (2,) corners of the visible area.
        near: (N,) points drawn strongly; the others are pale.
        bright: (N,) points of high reflectance.
        outlines: each with its style class.
    """

    points: _Doubles
    low: tuple[float, float]
    high: tuple[float, float]
    near: NDArray[np.bool_]
    bright: NDArray[np.bool_]
    outlines: Sequence[tuple[str, _Doubles]]


def crop_svg(points: NDArray[np.float32], ground: Ground | None, boxes: Sequence[DrawnBox]) -> str:
    """Draw three views of the surroundings of the first box, as an <svg> element with lengths in centimetres.

    In bird's-eye view the line of sight points up. In the side view the first box's ray-facing axis points right, and
    only points within its width are strong. In the sensor's view those within its depth are strong.

    Args:
        points: (N, 4) x, y, z in metres, the sensor at the origin, and reflectance.
        ground: ground surface; without it the first box's bottom is used.
        boxes: drawn boxes; the first one is centered.
    """
    middle = boxes[0].box
    reach = max(2.5, middle[3] / 2 + 2.0)
    close = points[(np.abs(points[:, :2] - middle[:2]) < 1.5 * reach).all(axis=1)].astype(np.float64)
    floor = middle[2] - middle[5] / 2
    if ground is not None:
        floor = float(ground.heights(middle[None, :2])[0])
        above = close[:, 2] - ground.heights(close[:, :2])
    else:
        above = close[:, 2] - floor
    offset, height = close[:, :2] - middle[:2], close[:, 2] - floor
    sight = middle[:2] / max(float(np.hypot(middle[0], middle[1])), 1e-6)
    heading = np.array([np.cos(middle[6]), np.sin(middle[6])])
    axis = -heading if heading @ sight < 0 else heading
    bright, standing = close[:, 3] >= BRIGHT_REFLECTANCE, above > _GROUND_M
    half = middle[3:5] / 2
    along, across = offset @ axis, offset @ _right_of(axis)
    depth, right = offset @ sight, offset @ _right_of(sight)
    inside = (np.abs(along) < half[0] + 0.3) & (np.abs(across) < half[1] + 0.3)
    corners = [footprints(outline.box[None])[0] - middle[:2] for outline in boxes]
    upwards = np.stack([_right_of(sight), sight], axis=1)
    outlines = [(_style(outline), place @ upwards) for outline, place in zip(boxes, corners, strict=True)]
    outlines += [(_style(outline), _arrow(outline, middle) @ upwards) for outline in boxes]
    panes = [
        _Pane(
            np.stack([right, depth], axis=1)[standing],
            (-reach, -reach),
            (reach, reach),
            inside[standing],
            bright[standing],
            outlines,
        )
    ]
    half_depth = abs(sight @ axis) * half[0] + abs(sight @ _right_of(axis)) * half[1] + 0.5
    for direction, horizontal, strong in (
        (axis, along, np.abs(across) < half[1] + 0.3),
        (_right_of(sight), right, np.abs(depth) < half_depth),
    ):
        outlines = [
            (_style(outline), _upright(place @ direction, outline.box, floor))
            for outline, place in zip(boxes, corners, strict=True)
            if outline.main
        ]
        heights = np.stack([horizontal, height], axis=1)
        panes.append(_Pane(heights, (-reach, _LOW_M), (reach, _HIGH_M), strong & standing, bright, outlines))
    return _svg(panes, round(100 * reach))


def _right_of(direction: _Doubles) -> _Doubles:
    return np.array([direction[1], -direction[0]])


def _style(outline: DrawnBox) -> str:
    return f"{outline.kind}{'' if outline.main else ' other'}"


def _arrow(outline: DrawnBox, middle: _Doubles) -> _Doubles:
    """Return the (2, 2) line from the box's center to slightly beyond its front."""
    heading = np.array([np.cos(outline.box[6]), np.sin(outline.box[6])])
    start = outline.box[:2] - middle[:2]
    return np.stack([start, start + heading * (outline.box[3] / 2 + 0.25)])


def _upright(horizontal: _Doubles, box: _Doubles, floor: float) -> _Doubles:
    """Return the (4, 2) rectangle of a box in side view, from the horizontal positions (4,) of its corners."""
    left, right = float(horizontal.min()), float(horizontal.max())
    bottom, top = (float(box[2] + side * box[5] / 2 - floor) for side in (-1, 1))
    return np.array([[left, bottom], [right, bottom], [right, top], [left, top]])


def _svg(panes: Sequence[_Pane], reach_cm: int) -> str:
    width = 2 * reach_cm
    tall = max(round(100 * (pane.high[1] - pane.low[1])) for pane in panes)
    total = len(panes) * width + (len(panes) - 1) * _GAP_CM
    parts = [f'<svg viewBox="0 0 {total} {tall}" role="img">']
    for number, pane in enumerate(panes):
        own_tall = round(100 * (pane.high[1] - pane.low[1]))
        left, top = number * (width + _GAP_CM), tall - own_tall
        parts.append(f'<svg x="{left}" y="{top}" width="{width}" height="{own_tall}">')
        parts.append(f'<rect class="pane" width="{width}" height="{own_tall}"/>')
        if pane.low[1] == _LOW_M:
            ground = round(100 * pane.high[1])
            parts.append(f'<path class="ground" d="M0 {ground}h{width}"/>')
        visible = ((pane.points > pane.low) & (pane.points < pane.high)).all(axis=1)
        for style, mask in (
            ("far", ~pane.near),
            ("near", pane.near & ~pane.bright),
            ("bright", pane.near & pane.bright),
        ):
            if path := _dots(pane, visible & mask):
                parts.append(f'<path class="{style}" d="{path}"/>')
        parts += [
            f'<polygon class="{style}" points="{" ".join(f"{x},{y}" for x, y in _pixels(pane, outline))}"/>'
            for style, outline in pane.outlines
        ]
        parts.append("</svg>")
    return "".join([*parts, "</svg>"])


def _dots(pane: _Pane, mask: NDArray[np.bool_]) -> str:
    """Return a path of dots, each a line of zero length with round ends."""
    pixels = np.unique(_pixels(pane, pane.points[mask]), axis=0)
    step = -(-len(pixels) // MAX_POINTS)
    return "".join(f"M{x} {y}h0" for x, y in pixels[:: max(step, 1)])


def _pixels(pane: _Pane, places: _Doubles) -> NDArray[np.int64]:
    """Convert metres (N, 2) to whole centimetres from the upper left corner."""
    return np.round(100 * np.stack([places[:, 0] - pane.low[0], pane.high[1] - places[:, 1]], axis=1)).astype(np.int64)


FALSE_CASES, MISSED_CASES, BOX_CASES = 24, 12, 6


@dataclass(frozen=True, eq=False)
class Case:
    """Error and its picture.

    Attributes:
        frame: index of its frame.
        boxes: drawn boxes, the first one centered.
        texts: caption lines.
        error: sort key of the cases of a section, largest first.
        score: score of the detection; 0 without one.
        points: number in the first box.
        frame_id, svg: name of the frame and picture, from `draw_cases`.
    """

    frame: int
    boxes: tuple[DrawnBox, ...]
    texts: tuple[str, ...]
    error: float
    score: float
    points: int
    frame_id: str = ""
    svg: str = ""

    @property
    def distance_m(self) -> float:
        """Horizontal distance of the first box."""
        return float(np.hypot(*self.boxes[0].box[:2]))


@dataclass(frozen=True)
class CaseSection:
    """Cases of one class and kind, the worst first."""

    class_name: str
    title: str
    cases: tuple[Case, ...]


def worst_cases(matches: Matches) -> list[CaseSection]:
    """Select the worst cases of each kind for every class; per section at most one of BLOCK_FRAMES neighboring frames.

    Neighboring frames of a drive have the same errors.
    """
    sections = []
    for name in matches.scores:
        objects = [item for item in matches.objects if item.class_name == name and item.counted]
        false = [
            _false_case(item, around)
            for item, around in zip(matches.detections, matches.surroundings, strict=True)
            if item.class_name == name and around is not None
        ]
        missed = [_missed_case(item) for item in objects if item.detection is None]
        sections += [
            CaseSection(name, "False detections, highest score first", _worst(false, FALSE_CASES)),
            CaseSection(name, "Missed objects, most points first", _worst(missed, MISSED_CASES)),
            *_box_sections(name, [item for item in objects if item.detection is not None]),
        ]
    return [section for section in sections if section.cases]


def draw_cases(
    frames: ErrorFrames, matches: Matches, sections: Sequence[CaseSection], *, reporter: Reporter = SILENT
) -> list[CaseSection]:
    """Return the sections with a picture (`crops.crop_svg`) of each case; every frame is read once.

    Raises:
        DatasetError, ScanError: a frame cannot be read.
    """
    places = [(row, column) for row, section in enumerate(sections) for column in range(len(section.cases))]
    places.sort(key=lambda place: sections[place[0]].cases[place[1]].frame)
    drawn = [list(section.cases) for section in sections]
    bar = reporter.track(places, "Drawing errors")
    for index, group in groupby(bar, lambda place: sections[place[0]].cases[place[1]].frame):
        frame = frames.read(matches.frame_ids[index])
        ground = fit_ground(frame.points)
        others = [DrawnBox(box, "label") for box in frame.objects]
        others += [
            DrawnBox(box, "detection")
            for box, kind, score in zip(frame.detections, frame.detection_types, frame.scores, strict=True)
            if score >= matches.scores.get(kind, np.inf)
        ]
        for row, column in group:
            case = drawn[row][column]
            svg = crop_svg(frame.points, ground, [*case.boxes, *others])
            drawn[row][column] = replace(case, frame_id=frame.frame_id, svg=svg)
    return [replace(section, cases=tuple(cases)) for section, cases in zip(sections, drawn, strict=True)]


def _worst(cases: Sequence[Case], count: int) -> tuple[Case, ...]:
    chosen: list[Case] = []
    blocks: set[int] = set()
    for case in sorted(cases, key=lambda case: -case.error):
        block = case.frame // BLOCK_FRAMES
        if len(chosen) < count and block not in blocks:
            chosen.append(case)
            blocks.add(block)
    return tuple(chosen)


def _false_case(item: DetectionMatch, around: Surroundings) -> Case:
    on = f"{item.kind} on {item.label}" if item.label else item.kind
    texts = (
        on,
        ", ".join(around.traits) or "no trait",
        f"top {around.top_m:.1f} m, reflectance {around.reflectance:.2f}",
    )
    return Case(item.frame, (DrawnBox(item.box, "detection", main=True),), texts, item.score, item.score, around.points)


def _missed_case(item: ObjectMatch) -> Case:
    texts = (view_of(item.view_deg).rpartition(" ")[2], "a box below the score" if item.below_score else "no box")
    return Case(item.frame, (DrawnBox(item.box, "label", main=True),), texts, item.points, 0.0, item.points)


def _box_sections(name: str, objects: Sequence[ObjectMatch]) -> list[CaseSection]:
    labels = np.array([item.box for item in objects]).reshape(-1, 7)
    detections = np.array([item.detection for item in objects]).reshape(-1, 7)
    residuals = dict(zip(RESIDUALS, box_residuals(detections, labels).T, strict=True))
    titles = {
        "near_end": "Near end",
        "far_end": "Far end",
        "near_side": "Near side",
        "far_side": "Far side",
        "bottom": "Bottom",
        "height": "Height",
        "range": "Distance",
        "heading_deg": "Heading",
    }
    sections = []
    for key, title in titles.items():
        unit = "degrees" if key == "heading_deg" else "m"
        cases = [
            _box_case(item, f"{title.lower()} {error:+.2f} {unit}", abs(error))
            for item, error in zip(objects, residuals[key].tolist(), strict=True)
        ]
        sections.append(CaseSection(name, f"{title}, largest error first", _worst(cases, BOX_CASES)))
    turned = [
        _box_case(item, "heading turned round", item.score)
        for item, is_turned in zip(objects, residuals["turned"].tolist(), strict=True)
        if is_turned
    ]
    sections.append(CaseSection(name, "Heading turned round, highest score first", _worst(turned, BOX_CASES)))
    return sections


def _box_case(item: ObjectMatch, text: str, error: float) -> Case:
    assert item.detection is not None, "boxes on objects"
    boxes = DrawnBox(item.box, "label", main=True), DrawnBox(item.detection, "detection", main=True)
    return Case(item.frame, boxes, (text, view_of(item.view_deg).rpartition(" ")[2]), error, item.score, item.points)
