"""The worst of each kind of error, to be looked at: false detections, missed objects, and boxes with large errors."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import groupby

import numpy as np
from rich.console import Console
from rich.progress import track

from asca_pillars.data.insertion.ground_fit import fit_ground
from asca_pillars.evaluation.errors.block_bootstrap import BLOCK_FRAMES
from asca_pillars.evaluation.errors.box_errors import RESIDUALS, DetectionMatch, ObjectMatch, box_residuals
from asca_pillars.evaluation.errors.crops import DrawnBox, crop_svg
from asca_pillars.evaluation.errors.error_frames import ErrorFrames
from asca_pillars.evaluation.errors.error_summary import Matches, view_of
from asca_pillars.evaluation.errors.false_detections import Surroundings

FALSE_CASES, MISSED_CASES, BOX_CASES = 24, 12, 6


@dataclass(frozen=True, eq=False)
class Case:
    """One error and how to show it.

    Attributes:
        frame: index of its frame.
        boxes: what is drawn strongly, the first one in the middle.
        texts: what stands below the picture.
        error: what cases of one section are ordered by, the largest first.
        score: of the detection; 0 without one.
        points: in the first box.
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
    """For every class the worst cases of each kind; of BLOCK_FRAMES neighboring frames at most one in a section.

    Neighboring frames of a drive show the same error again and again.
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
    frames: ErrorFrames, matches: Matches, sections: Sequence[CaseSection], *, console: Console | None = None
) -> list[CaseSection]:
    """The same sections with a picture (`crops.crop_svg`) of each case; every frame is read once.

    Raises:
        DatasetError, ScanError: a frame cannot be read.
    """
    places = [(row, column) for row, section in enumerate(sections) for column in range(len(section.cases))]
    places.sort(key=lambda place: sections[place[0]].cases[place[1]].frame)
    drawn = [list(section.cases) for section in sections]
    bar = track(places, "Drawing errors", console=console, disable=console is None)
    for index, group in groupby(bar, lambda place: sections[place[0]].cases[place[1]].frame):
        frame = frames.read(matches.frame_ids[index])
        ground = fit_ground(frame.points)
        others = [DrawnBox(box, "label") for box in frame.objects]
        others += [
            DrawnBox(box, "detection")
            for box, kind, score in zip(frame.found, frame.found_types, frame.scores, strict=True)
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
    found = np.array([item.detection for item in objects]).reshape(-1, 7)
    residuals = dict(zip(RESIDUALS, box_residuals(found, labels).T, strict=True))
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
