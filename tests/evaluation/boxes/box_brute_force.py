"""The metrics of `evaluation.boxes` once more, from their definitions, with loops and shapely; and random frames."""

import math
from collections.abc import Callable
from functools import cache

import numpy as np
from shapely.affinity import rotate, translate
from shapely.geometry import box as rectangle

from asca_pillars.evaluation.boxes.box_pairs import EvaluatedFrame

Box = list[float]
SAMPLES = np.linspace(0, 1, 101).tolist()  # 0.28 is not 7 / 25 to the last digit, and the devkits take these


def random_frames(seed: int, frames: int = 6, classes: tuple[str, ...] = ("Car", "Forklift")) -> list[EvaluatedFrame]:
    """Objects around the sensor, detections near most of them, doubles and false ones; no two scores are equal."""
    rng = np.random.default_rng(seed)
    scores = rng.permutation(np.linspace(0.01, 0.99, 40 * frames))
    result = []
    for number in range(frames):
        count = int(rng.integers(0, 9))
        objects = np.column_stack([rng.uniform(-60, 60, (count, 2)), rng.uniform(-1, 0, count)])
        objects = np.column_stack([objects, rng.uniform(1, 5, (count, 3)), rng.uniform(-3.1, 3.1, count)])
        near = np.repeat(objects, rng.integers(0, 3, count), axis=0)
        near[:, :3] += rng.normal(0, 0.6, (len(near), 3)) * rng.choice([0.3, 1.0, 3.0], (len(near), 1))
        near[:, 3:6] *= rng.uniform(0.8, 1.25, (len(near), 3))
        near[:, 6] += rng.normal(0, 0.3, len(near))
        wild = np.column_stack([rng.uniform(-60, 60, (3, 3)), rng.uniform(1, 5, (3, 3)), rng.uniform(-3, 3, 3)])
        found = np.concatenate([near, wild])
        types, seen = rng.choice(classes, count).tolist(), rng.random(count) < 0.9
        kinds, own = rng.choice(classes, len(found)).tolist(), scores[40 * number : 40 * number + len(found)]
        result.append(EvaluatedFrame(str(number), objects, types, seen, found, kinds, own))
    return result


@cache
def overlaps(a: tuple[float, ...], b: tuple[float, ...]) -> tuple[float, float]:
    """IoU from above, and of the volumes."""
    flat = [rectangle(-o[3] / 2, -o[4] / 2, o[3] / 2, o[4] / 2) for o in (a, b)]
    turned = [translate(rotate(one, o[6], use_radians=True), o[0], o[1]) for one, o in zip(flat, (a, b), strict=True)]
    shared = turned[0].intersection(turned[1]).area
    tall = min(a[2] + a[5] / 2, b[2] + b[5] / 2) - max(a[2] - a[5] / 2, b[2] - b[5] / 2)
    volume = shared * max(tall, 0)
    return shared / (a[3] * a[4] + b[3] * b[4] - shared), volume / (math.prod(a[3:6]) + math.prod(b[3:6]) - volume)


def iou(a: Box, b: Box, *, flat: bool) -> float:
    return overlaps(tuple(a), tuple(b))[not flat]


def ranked(frames: list[EvaluatedFrame], name: str) -> list[tuple[float, int, Box]]:
    """Score, frame and box of every detection of a class, best first."""
    every = [
        (float(score), number, [float(value) for value in box])
        for number, frame in enumerate(frames)
        for box, kind, score in zip(frame.detections, frame.detection_types, frame.scores, strict=True)
        if kind == name
    ]
    return sorted(every, key=lambda item: -item[0])


def objects_of(frames: list[EvaluatedFrame], name: str, *, visible: bool) -> list[tuple[int, Box]]:
    return [
        (number, [float(value) for value in box])
        for number, frame in enumerate(frames)
        for box, kind, seen in zip(frame.objects, frame.object_types, frame.visible, strict=True)
        if kind == name and bool(seen) == visible
    ]


def take(frames: list[EvaluatedFrame], name: str, far: Callable[[Box, Box], float], limit: float, *, ties: bool):
    """For each ranked detection the object that it takes, or None: the nearest free one below the limit."""
    objects, taken, result = objects_of(frames, name, visible=True), set(), []
    for score, number, box in ranked(frames, name):
        options = [(far(box, other), k) for k, (own, other) in enumerate(objects) if own == number and k not in taken]
        best = min(options, default=(math.inf, -1))
        hit = best[0] <= limit if ties else best[0] < limit
        if hit:
            taken.add(best[1])
        result.append((score, number, box, objects[best[1]][1] if hit else None))
    return result, len(objects)


def iou_ap(frames: list[EvaluatedFrame], name: str, least: float, keep: Callable[[Box], bool], *, flat: bool):
    taken, _ = take(frames, name, lambda a, b: -iou(a, b, flat=flat), -least, ties=True)
    total = sum(keep(box) for _, box in objects_of(frames, name, visible=True))
    hidden = objects_of(frames, name, visible=False)
    curve, true, false = [], 0, 0
    for _, number, box, owner in taken:
        if owner is None and any(own == number and iou(box, other, flat=flat) >= least for own, other in hidden):
            continue
        if not keep(owner or box):
            continue
        true, false = true + (owner is not None), false + (owner is None)
        curve.append((true / total if total else 0, true / (true + false)))
    if not total:
        return None
    # The area under a staircase: between two recalls the best precision at the higher one or beyond.
    area, before = 0.0, 0.0
    for index, (recall, _) in enumerate(curve):
        area += (recall - before) * max(precision for _, precision in curve[index:])
        before = recall
    return 100 * area


def interpolate(at: float, xs: list[float], ys: list[float]) -> float:
    """A line through the points; level before the first. Of points with one x the last counts, as in NumPy."""
    last = max((i for i, x in enumerate(xs) if x <= at), default=-1)
    if last in (-1, len(xs) - 1) or xs[last] == at:
        return ys[max(last, 0)]
    return ys[last] + (ys[last + 1] - ys[last]) * (at - xs[last]) / (xs[last + 1] - xs[last])


def nuscenes_errors(box: Box, other: Box) -> list[float]:
    shared = math.prod(min(a, b) for a, b in zip(box[3:6], other[3:6], strict=True))
    size = 1 - shared / (math.prod(box[3:6]) + math.prod(other[3:6]) - shared)
    return [math.dist(box[:2], other[:2]), size, turned(box, other)]


def argoverse_errors(box: Box, other: Box) -> list[float]:
    # Each extent counts with the ratio of the smaller one to the larger one.
    kept = math.prod(min(a, b) / max(a, b) for a, b in zip(box[3:6], other[3:6], strict=True))
    return [math.dist(box[:3], other[:3]), 1 - kept, turned(box, other)]


def turned(box: Box, other: Box) -> float:
    return abs(math.remainder(box[6] - other[6], 2 * math.pi))


def nuscenes(frames: list[EvaluatedFrame], name: str) -> tuple[float, list[float]]:
    """AP in percent, and the three errors."""
    aps, errors = [], [1.0, 1.0, 1.0]
    for limit in (0.5, 1.0, 2.0, 4.0):
        taken, total = take(frames, name, lambda a, b: math.dist(a[:2], b[:2]), limit, ties=False)
        hits = [owner is not None for *_, owner in taken]
        recalls = [sum(hits[: n + 1]) / total for n in range(len(hits))]
        precisions = [sum(hits[: n + 1]) / (n + 1) for n in range(len(hits))]
        above, confidence = 0.0, []
        for percent in range(101):
            recall = SAMPLES[percent]
            reached = any(hits) and recall <= recalls[-1]
            confidence.append(interpolate(recall, recalls, [item[0] for item in taken]) if reached else 0.0)
            if percent > 10 and reached:
                above += max(interpolate(recall, recalls, precisions) - 0.1, 0)
        aps.append(100 * above / 90 / 0.9)
        if limit == 2.0 and confidence[11] > 0:
            each = [(score, nuscenes_errors(box, owner)) for score, _, box, owner in taken if owner is not None]
            running = [[sum(e[k] for _, e in each[: n + 1]) / (n + 1) for k in range(3)] for n in range(len(each))]
            scores = [score for score, _ in each][::-1]
            sampled = [c for c in confidence[11:] if c > 0]
            errors = [
                sum(interpolate(c, scores, [row[k] for row in running][::-1]) for c in sampled) / len(sampled)
                for k in range(3)
            ]
    return sum(aps) / 4, errors


def argoverse(frames: list[EvaluatedFrame], name: str) -> tuple[float, list[float], float]:
    """AP in percent, the three errors, CDS in percent."""
    objects, owners = objects_of(frames, name, visible=True), set()
    firsts = []  # for each ranked detection: distance to the object that it is the first one of
    for _, number, box in ranked(frames, name):
        options = [(math.dist(box[:3], other[:3]), k) for k, (own, other) in enumerate(objects) if own == number]
        away, k = min(options, default=(math.inf, -1))
        first = bool(options) and k not in owners
        owners.add(k)
        firsts.append((away if first else math.inf, box, objects[k][1] if first else None))
    aps = []
    for limit in (0.5, 1.0, 2.0, 4.0):
        curve, true = [], 0
        for n, (away, *_) in enumerate(firsts):
            true += away < limit
            curve.append((true / len(objects), true / (n + 1)))
        total = 0.0
        for percent in range(101):
            if curve and SAMPLES[percent] <= curve[-1][0]:
                best = [max(precision for _, precision in curve[n:]) for n in range(len(curve))]
                total += interpolate(SAMPLES[percent], [recall for recall, _ in curve], best)
        aps.append(total / 101)
    each = [argoverse_errors(box, own) for away, box, own in firsts if own is not None and away < 2]
    errors = [sum(e[k] for e in each) / len(each) for k in range(3)] if each else [2.0, 1.0, math.pi]
    ap = sum(aps) / 4
    cds = ap * sum(1 - error / worst for error, worst in zip(errors, (2, 1, math.pi), strict=True)) / 3
    return 100 * ap, errors, 100 * cds
