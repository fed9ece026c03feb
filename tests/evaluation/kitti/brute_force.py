"""The KITTI protocol as plain loops over its rules, with overlaps by shapely: slow, and hard to get wrong."""

import math
from collections import namedtuple
from functools import cache
from typing import Any, NamedTuple

import shapely
import shapely.affinity

from asca_pillars.evaluation.kitti.objects import FrameObjects

HEIGHTS = {"easy": 40, "moderate": 25, "hard": 25}
OCCLUSIONS = {"easy": 0, "moderate": 1, "hard": 2}
TRUNCATIONS = {"easy": 0.15, "moderate": 0.3, "hard": 0.5}
NEIGHBORS = {"car": "van", "pedestrian": "person_sitting"}
Band = tuple[float, float] | None
Thing = namedtuple("Thing", "type bbox alpha hwl location rotation_y truncated occluded score")
"""One object of one frame."""


class ReferenceCurve(NamedTuple):
    """What `evaluation.kitti.Curve` should be."""

    precision: list[float]
    counted: int
    matched: int
    thresholds: list[float]
    tp: list[int]
    fp: list[int]
    fn: list[int]


def brute_force(
    truth: list[FrameObjects], detections: list[FrameObjects], class_names: tuple[str, ...], band: Band = None
) -> dict[tuple[str, str, str], ReferenceCurve]:
    """Every curve that the official tool would compute, by (class name, metric, difficulty)."""
    frames = [(things(gt), things(det)) for gt, det in zip(truth, detections, strict=True)]
    everything = [thing for _, found in frames for thing in found]
    curves = {}
    for name in class_names:
        own = [thing for thing in everything if thing.type == name.lower()]
        known = {
            "bbox": any(thing.bbox[0] >= 0 for thing in own),
            "bev": any(thing.location[0] != -1000 for thing in own),
            "3d": any(thing.location[1] != -1000 for thing in own),
        }
        for metric in [metric for metric in known if known[metric]]:
            for difficulty in HEIGHTS:
                precise, oriented = curve(frames, name.lower(), metric, difficulty, band)
                curves[name, metric, difficulty] = precise
                if metric == "bbox" and all(thing.alpha != -10 for thing in everything):
                    curves[name, "aos", difficulty] = oriented
    return curves


def things(frame: FrameObjects) -> list[Thing]:
    numbers = frame.bbox, frame.alpha, frame.dimensions_hwl, frame.locations, frame.rotation_y, frame.truncated
    rows = zip(*(part.tolist() for part in (*numbers, frame.occluded, frame.scores)), strict=True)
    return [
        Thing(name.lower(), *(tuple(part) if isinstance(part, list) else part for part in row))
        for name, row in zip(frame.types, rows, strict=True)
    ]


def curve(frames: list, name: str, metric: str, difficulty: str, band: Band) -> tuple[ReferenceCurve, ReferenceCurve]:
    def passes(threshold: float | None) -> list[tuple[list[float], int, int, float]]:
        return [match(truths, found, name, metric, difficulty, band, threshold) for truths, found in frames]

    counted = sum(truth_state(gt, name, difficulty, band) == "counted" for truths, _ in frames for gt in truths)
    scores = [score for matched, *_ in passes(None) for score in matched]
    thresholds = pick_thresholds(scores, counted)
    second: Any = [passes(threshold) for threshold in thresholds]
    tp = [sum(len(one[0]) for one in each) for each in second]
    fp, fn, similarity = ([sum(one[place] for one in each) for each in second] for place in (1, 2, 3))
    rest: Any = (counted, len(scores), thresholds, tp, fp, fn)
    return ReferenceCurve(envelope(tp, tp, fp), *rest), ReferenceCurve(envelope(similarity, tp, fp), *rest)


def envelope(gains: list, tp: list[int], fp: list[int]) -> list[float]:
    values = [gain / (a + b) if a + b else 0.0 for gain, a, b in zip(gains, tp, fp, strict=True)]
    values += [0.0] * (41 - len(values))
    return [max(values[index:]) for index in range(41)]


def pick_thresholds(scores: list[float], counted: int) -> list[float]:
    picked, current = [], 0.0
    for i, score in enumerate(sorted(scores, reverse=True)):
        if i < len(scores) - 1 and (i + 2) / counted - current < current - (i + 1) / counted:
            continue
        picked.append(score)
        current += 1 / 40
    return picked


def match(
    truths: list[Thing], found: list[Thing], name: str, metric: str, difficulty: str, band: Band, least: float | None
) -> tuple[list[float], int, int, float]:
    """Scores of the true positives, number of false positives and of misses, and the headings' similarity."""
    overlap = {"bbox": overlap_2d, "bev": overlap_bev, "3d": overlap_3d}[metric]
    minimum = 0.7 if name == "car" else 0.5
    states = [detection_state(det, name, difficulty, band) for det in found]
    pairs = zip(found, states, strict=True)
    usable = [state != "absent" and (least is None or det.score >= least) for det, state in pairs]
    matched, missed, similar = [], 0, 0.0
    for gt in truths:
        state = truth_state(gt, name, difficulty, band)
        if state == "absent":
            continue
        winner = None
        for j, det in enumerate(found):
            if not usable[j] or overlap(det, gt) <= minimum:
                continue
            if winner is None:
                winner = j
            elif least is None:
                winner = j if det.score > found[winner].score else winner
            elif states[j] == "counted" and (
                states[winner] == "ignored" or overlap(det, gt) > overlap(found[winner], gt)
            ):
                winner = j
        if winner is None:
            missed += state == "counted"
            continue
        usable[winner] = False
        if state == states[winner] == "counted":
            matched.append(found[winner].score)
            similar += (1 + math.cos(gt.alpha - found[winner].alpha)) / 2
    areas = [gt for gt in truths if gt.type == "dontcare"]
    false = 0
    for det, state, left in zip(found, states, usable, strict=True):
        excused = metric == "bbox" and any(shared_2d(det, area) / area_2d(det) > minimum for area in areas)
        false += left and state == "counted" and not excused
    return matched, false, missed, similar


def truth_state(gt: Thing, name: str, difficulty: str, band: Band) -> str:
    if gt.type not in (name, NEIGHBORS.get(name)):
        return "absent"
    low = gt.bbox[3] - gt.bbox[1] < HEIGHTS[difficulty]
    hidden = gt.occluded > OCCLUSIONS[difficulty] or gt.truncated > TRUNCATIONS[difficulty]
    return "ignored" if gt.type != name or low or hidden or outside(gt, band) else "counted"


def detection_state(det: Thing, name: str, difficulty: str, band: Band) -> str:
    if int(abs(det.bbox[1] - det.bbox[3])) < HEIGHTS[difficulty]:
        return "ignored"
    if det.type != name:
        return "absent"
    return "ignored" if outside(det, band) else "counted"


def outside(thing: Thing, band: Band) -> bool:
    return band is not None and not band[0] <= math.hypot(thing.location[0], thing.location[2]) < band[1]


def shared_2d(a: Thing, b: Thing) -> float:
    width, height = (min(a.bbox[i + 2], b.bbox[i + 2]) - max(a.bbox[i], b.bbox[i]) for i in (0, 1))
    return width * height if width > 0 and height > 0 else 0.0


def area_2d(a: Thing) -> float:
    return (a.bbox[2] - a.bbox[0]) * (a.bbox[3] - a.bbox[1]) or math.inf  # that of a box of -1 everywhere is 0


def overlap_2d(det: Thing, gt: Thing) -> float:
    shared = shared_2d(det, gt)
    return shared / (area_2d(det) + area_2d(gt) - shared)


@cache
def shared_bev(det: Thing, gt: Thing) -> float:
    if min(*det.hwl, *gt.hwl) <= 0:
        return 0.0
    # About the ground truth: at 70 m shapely's own rounding would be larger than ours.
    return float(footprint(det, gt.location).intersection(footprint(gt, gt.location)).area)


def footprint(thing: Thing, origin: tuple[float, ...]) -> shapely.Polygon:
    _, width, length = thing.hwl
    flat = shapely.box(-length / 2, -width / 2, length / 2, width / 2)
    turned = shapely.affinity.rotate(flat, -thing.rotation_y, origin=(0, 0), use_radians=True)
    return shapely.affinity.translate(turned, thing.location[0] - origin[0], thing.location[2] - origin[2])


def overlap_bev(det: Thing, gt: Thing) -> float:
    shared = shared_bev(det, gt)
    return shared / (det.hwl[1] * det.hwl[2] + gt.hwl[1] * gt.hwl[2] - shared) if shared else 0.0


def overlap_3d(det: Thing, gt: Thing) -> float:
    bottom, top = min(det.location[1], gt.location[1]), max(det.location[1] - det.hwl[0], gt.location[1] - gt.hwl[0])
    shared = shared_bev(det, gt) * max(0.0, bottom - top)
    return shared / (math.prod(det.hwl) + math.prod(gt.hwl) - shared) if shared else 0.0
