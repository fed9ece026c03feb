"""The KITTI protocol as plain loops over its rules, with overlaps by shapely: slow, and hard to get wrong."""

import math
from functools import cache
from typing import NamedTuple

import shapely
import shapely.affinity

from asca_pillars.evaluation.kitti.objects import FrameObjects

HEIGHTS = {"easy": 40, "moderate": 25, "hard": 25}
OCCLUSIONS = {"easy": 0, "moderate": 1, "hard": 2}
TRUNCATIONS = {"easy": 0.15, "moderate": 0.3, "hard": 0.5}
NEIGHBORS = {"car": "van", "pedestrian": "person_sitting"}
Band = tuple[float, float] | None


class Thing(NamedTuple):
    """One object of one frame."""

    type: str
    bbox: tuple[float, ...]
    alpha: float
    hwl: tuple[float, ...]
    location: tuple[float, ...]
    rotation_y: float
    truncated: float
    occluded: float
    score: float


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
    rows = zip(
        frame.bbox.tolist(),
        frame.alpha.tolist(),
        frame.dimensions_hwl.tolist(),
        frame.locations.tolist(),
        frame.rotation_y.tolist(),
        frame.truncated.tolist(),
        frame.occluded.tolist(),
        frame.scores.tolist(),
        strict=True,
    )
    return [
        Thing(name.lower(), tuple(bbox), alpha, tuple(hwl), tuple(location), *rest)
        for name, (bbox, alpha, hwl, location, *rest) in zip(frame.types, rows, strict=True)
    ]


def curve(frames: list, name: str, metric: str, difficulty: str, band: Band) -> tuple[ReferenceCurve, ReferenceCurve]:
    counted = sum(truth_state(gt, name, difficulty, band) == "counted" for truths, _ in frames for gt in truths)
    scores = []
    for truths, found in frames:
        scores += match(truths, found, name, metric, difficulty, band, None)[0]
    thresholds = pick_thresholds(scores, counted)
    tp: list[int] = []
    fp: list[int] = []
    fn: list[int] = []
    similarity: list[float] = []
    for threshold in thresholds:
        for counts in (tp, fp, fn):
            counts.append(0)
        similarity.append(0.0)
        for truths, found in frames:
            matched, false, missed, similar = match(truths, found, name, metric, difficulty, band, threshold)
            tp[-1] += len(matched)
            fp[-1] += false
            fn[-1] += missed
            similarity[-1] += similar
    rest = (counted, len(scores), thresholds, tp, fp, fn)
    return ReferenceCurve(envelope(tp, tp, fp), *rest), ReferenceCurve(envelope(similarity, tp, fp), *rest)


def envelope(gains: list, tp: list[int], fp: list[int]) -> list[float]:
    values = [gain / (a + b) if a + b else 0.0 for gain, a, b in zip(gains, tp, fp, strict=True)]
    values += [0.0] * (41 - len(values))
    return [max(values[index:]) for index in range(41)]


def pick_thresholds(scores: list[float], counted: int) -> list[float]:
    scores = sorted(scores, reverse=True)
    picked, current = [], 0.0
    for i, score in enumerate(scores):
        last = i == len(scores) - 1
        if not last and (i + 2) / counted - current < current - (i + 1) / counted:
            continue
        picked.append(score)
        current += 1 / 40
    return picked


def match(
    truths: list[Thing],
    found: list[Thing],
    name: str,
    metric: str,
    difficulty: str,
    band: Band,
    threshold: float | None,
) -> tuple[list[float], int, int, float]:
    """Scores of the true positives, number of false positives and of misses, and the headings' similarity."""
    overlap = {"bbox": overlap_2d, "bev": overlap_bev, "3d": overlap_3d}[metric]
    minimum = 0.7 if name == "car" else 0.5
    states = [detection_state(det, name, difficulty, band) for det in found]
    usable = [
        state != "absent" and (threshold is None or det.score >= threshold)
        for det, state in zip(found, states, strict=True)
    ]
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
            elif threshold is None:
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
        excused = metric == "bbox" and any(share_2d(det, area) > minimum for area in areas)
        false += left and state == "counted" and not excused
    return matched, false, missed, similar


def truth_state(gt: Thing, name: str, difficulty: str, band: Band) -> str:
    if gt.type == NEIGHBORS.get(name):
        return "ignored"
    if gt.type != name:
        return "absent"
    low = gt.bbox[3] - gt.bbox[1] < HEIGHTS[difficulty]
    hidden = gt.occluded > OCCLUSIONS[difficulty] or gt.truncated > TRUNCATIONS[difficulty]
    return "ignored" if low or hidden or outside(gt, band) else "counted"


def detection_state(det: Thing, name: str, difficulty: str, band: Band) -> str:
    if int(abs(det.bbox[1] - det.bbox[3])) < HEIGHTS[difficulty]:
        return "ignored"
    if det.type != name:
        return "absent"
    return "ignored" if outside(det, band) else "counted"


def outside(thing: Thing, band: Band) -> bool:
    return band is not None and not band[0] <= math.hypot(thing.location[0], thing.location[2]) < band[1]


def shared_2d(a: Thing, b: Thing) -> float:
    width = min(a.bbox[2], b.bbox[2]) - max(a.bbox[0], b.bbox[0])
    height = min(a.bbox[3], b.bbox[3]) - max(a.bbox[1], b.bbox[1])
    return width * height if width > 0 and height > 0 else 0.0


def area_2d(a: Thing) -> float:
    return (a.bbox[2] - a.bbox[0]) * (a.bbox[3] - a.bbox[1])


def overlap_2d(det: Thing, gt: Thing) -> float:
    shared = shared_2d(det, gt)
    return shared / (area_2d(det) + area_2d(gt) - shared) if shared else 0.0


def share_2d(det: Thing, area: Thing) -> float:
    shared = shared_2d(det, area)
    return shared / area_2d(det) if shared else 0.0


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
