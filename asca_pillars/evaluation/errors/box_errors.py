"""Matches of objects and detections, and the errors of matched boxes along the axes of their labels.

Each reported detection, by descending score, is matched to the free object of its class, or of the neighboring type
(KITTI's Van for Car), with the largest BEV IoU, if that is at least `evaluation.recall`'s minimum. The remaining
detections and objects are matched in the same way from LOCALIZATION_IOU on: these objects are not found, but
the errors of these boxes are included. Detections without an object are false positives. Their kinds are those of
TIDE (Bolya et al., ECCV 2020), with BEV IoU:

    localization     at LOCALIZATION_IOU or more on an object of its class, below the minimum
    classification   at LOCALIZATION_IOU or more on an object of another class
    duplicate        on an object that a better detection has taken
    background       on no label

Errors are predicted minus label. Ends and sides are faces: positive means too far out. The ray-facing axis is the
label's heading or its opposite, whichever points away from the sensor; the near end is the face where it enters. For an
object seen side-on no end is nearer, for one seen end-on no side is; the names are then arbitrary.

A false positive is described by its surroundings: height, brightness, number of points, and points beside the box.
Everything is measured on all points of the scan above the ground. A detection may
have several traits or none. The traits are the same for every class, but have different causes: points above 2.3 m at a
detected person indicate a post or a trunk, at a car a van, a wall or a hedge.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from asca_pillars.data.frames import NEIGHBOR_TYPES
from asca_pillars.data.insertion.ground_fit import Ground, cluster_labels
from asca_pillars.detection.targets import match_by_overlap
from asca_pillars.evaluation.errors.error_frames import ErrorFrame
from asca_pillars.evaluation.errors.label_fit import view_angle_deg
from asca_pillars.evaluation.recall import BEV_IOU, SMALL_BEV_IOU
from asca_pillars.geometry.boxes import Floats, Ints, Mask, wrap_angle
from asca_pillars.geometry.overlap import bev_iou

LOCALIZATION_IOU = 0.1
FALSE_KINDS = ("background", "localization", "classification", "duplicate")

RESIDUALS = {
    "near_end": "m; face across the ray-facing axis, on the sensor's side; positive: too far out",
    "far_end": "m; the opposite face; positive: too far out",
    "length": "m; near end and far end together",
    "near_side": "m; the long face on the sensor's side; positive: too far out",
    "far_side": "m; the opposite face; positive: too far out",
    "width": "m; both sides together",
    "bottom": "m; positive: too high",
    "top": "m; positive: too high",
    "height": "m; top - bottom",
    "range": "m; center along the line of sight; positive: too far away",
    "left": "m; center across the line of sight; positive: too far left",
    "heading_deg": "degrees of the axis, within -90 to 90, counter-clockwise; the direction is `turned`",
    "turned": "share of headings that are off by more than 90 degrees",
}
"""Names of the columns of `box_residuals`."""

_NONE = -1
_MIN_SIZE_M = 0.1
_FACES = tuple(list(RESIDUALS).index(name) for name in ("near_end", "far_end", "near_side", "far_side"))
_BOTTOM, _TOP, _HEADING, _TURNED = (list(RESIDUALS).index(name) for name in ("bottom", "top", "heading_deg", "turned"))
CORRECTIONS: dict[str, tuple[int, ...]] = {
    "as drawn": (),
    "label's ends": _FACES[:2],
    "label's sides": _FACES[2:],
    "label's bottom and top": (_BOTTOM, _TOP),
    "label's heading": (_HEADING,),
}
"""Parts of a box that `corrected` replaces by the label's, as columns of `box_residuals`."""


@dataclass(frozen=True, eq=False)
class ObjectMatch:
    """Labelled object of an evaluated class, and the detection matched to it.

    Attributes:
        frame: index of the frame.
        class_name: type of the object.
        box: (7,) label, sensor at the origin.
        points: number of points in the box, at least one.
        view_deg: angle between heading and line of sight, 0 to 90.
        neighbor_m: distance to the nearest other object of its type.
        counted: counts as an object to find, by the protocol.
        found: matched to a reported detection.
        below_score: not found, but would be by a detection below the score threshold.
        detection: (7,) the detection matched to it, with enough overlap or less; None without one.
        score: score of that detection.
    """

    frame: int
    class_name: str
    box: Floats
    points: int
    occluded: int
    truncated: float
    view_deg: float
    neighbor_m: float
    counted: bool
    found: bool
    below_score: bool
    detection: Floats | None
    score: float


@dataclass(frozen=True, eq=False)
class DetectionMatch:
    """Detection of an evaluated class with at least the lowest score.

    Attributes:
        frame: index of the frame.
        class_name: type of the detection.
        box: (7,) sensor at the origin.
        score: score of the detection.
        reported: reaches the score threshold.
        kind: one of FALSE_KINDS for a false positive, "found" on a counted object, "ignored" otherwise.
        label: type of the object that a false positive overlaps; empty for `background`.
    """

    frame: int
    class_name: str
    box: Floats
    score: float
    reported: bool
    kind: str
    label: str

    @property
    def is_false(self) -> bool:
        """True if it is a reported false positive."""
        return self.reported and self.kind in FALSE_KINDS


def least_iou(class_name: str) -> float:
    """Return the least BEV IoU of a found object."""
    return BEV_IOU.get(class_name, SMALL_BEV_IOU)


def match_frame(
    frame: ErrorFrame, index: int, class_name: str, score: float
) -> tuple[list[ObjectMatch], list[DetectionMatch]]:
    """Match the objects and detections of one class of a frame.

    Args:
        frame: the frame.
        index: number of the frame, stored in the matches.
        class_name: type of the objects and detections.
        score: least score of reported detections.
    """
    types = np.array(frame.types, dtype=object)
    of_class = types == class_name
    related = of_class | (types == NEIGHBOR_TYPES.get(class_name, ""))
    order = np.flatnonzero(np.array(frame.detection_types, dtype=object) == class_name)
    order = order[np.argsort(-frame.scores[order], kind="stable")]
    boxes, scores, ignored = frame.detections[order], frame.scores[order], frame.ignored[order]
    reported = scores >= score
    overlap = bev_iou(boxes, frame.objects)

    # Descending scores, so that detections below the threshold do not match objects before those above it.
    match = _match(overlap, np.ones(len(order), bool), related, least_iou(class_name))
    found = (match >= 0) & np.append(reported, False)[match]
    unmatched = reported.copy()
    unmatched[match[match >= 0]] = False
    badly_placed = _match(overlap, unmatched, related & ~found, LOCALIZATION_IOU)

    object_of = np.full(len(order), _NONE)
    object_of[match[match >= 0]] = np.flatnonzero(match >= 0)
    detections = []
    for row, item in enumerate(object_of):
        if item >= 0:
            kind, label = ("found" if of_class[item] and frame.counted[item] else "ignored"), ""
        elif ignored[row]:
            kind, label = "ignored", ""
        else:
            kind, label = _false_kind(overlap[row], types, related, least_iou(class_name))
        detections.append(
            DetectionMatch(index, class_name, boxes[row], float(scores[row]), bool(reported[row]), kind, label)
        )

    view, neighbors = view_angle_deg(frame.objects), _nearest_m(frame.objects, of_class)
    objects = []
    for row in np.flatnonzero(of_class & (frame.object_points > 0)).tolist():
        detection = int(match[row] if found[row] else badly_placed[row])
        objects.append(
            ObjectMatch(
                frame=index,
                class_name=class_name,
                box=frame.objects[row],
                points=int(frame.object_points[row]),
                occluded=int(frame.occluded[row]),
                truncated=float(frame.truncated[row]),
                view_deg=float(view[row]),
                neighbor_m=float(neighbors[row]),
                counted=bool(frame.counted[row]),
                found=bool(found[row]),
                below_score=bool(match[row] >= 0 and not found[row]),
                detection=None if detection == _NONE else boxes[detection],
                score=float("nan") if detection == _NONE else float(scores[detection]),
            )
        )
    return objects, detections


def box_residuals(detections: Floats, labels: Floats) -> Floats:
    """Compute errors of detections[k] against labels[k], sensor at the origin: (K, 7), (K, 7) -> (K, len(RESIDUALS)).

    A box rotated by more than 45 degrees against its label's axis is compared along its other axis: its extent
    gives ends and sides, and its heading error is the rotation itself.
    """
    turn = wrap_angle(detections[:, 6] - labels[:, 6])
    axis_turn = wrap_angle(turn, np.pi)
    across_first = np.abs(axis_turn) > np.pi / 4
    length, width = np.where(across_first, detections[:, [4, 3]].T, detections[:, [3, 4]].T)
    axis, near_side = _ray_facing_axes(labels)
    offset = detections[:, :2] - labels[:, :2]
    along = (offset * axis).sum(axis=1)
    across = near_side * (offset[:, 1] * axis[:, 0] - offset[:, 0] * axis[:, 1])
    line = labels[:, :2] / np.maximum(np.linalg.norm(labels[:, :2], axis=1, keepdims=True), 1e-9)
    bottom = (detections[:, 2] - detections[:, 5] / 2) - (labels[:, 2] - labels[:, 5] / 2)
    top = (detections[:, 2] + detections[:, 5] / 2) - (labels[:, 2] + labels[:, 5] / 2)
    longer, wider = (length - labels[:, 3]) / 2, (width - labels[:, 4]) / 2
    columns = {
        "near_end": longer - along,
        "far_end": longer + along,
        "length": 2 * longer,
        "near_side": wider + across,
        "far_side": wider - across,
        "width": 2 * wider,
        "bottom": bottom,
        "top": top,
        "height": top - bottom,
        "range": (offset * line).sum(axis=1),
        "left": offset[:, 1] * line[:, 0] - offset[:, 0] * line[:, 1],
        "heading_deg": np.rad2deg(axis_turn),
        "turned": (np.abs(turn) > np.pi / 2).astype(np.float64),
    }
    return np.stack([columns[name] for name in RESIDUALS], axis=1)


def boxes_from_residuals(labels: Floats, residuals: Floats) -> Floats:
    """Invert `box_residuals`: (K, 7), (K, len(RESIDUALS)) -> (K, 7), from ends, sides, bottom, top and heading.

    Boxes rotated by more than 45 degrees are returned with the same footprint, length and width exchanged.
    """
    part = dict(zip(RESIDUALS, residuals.T, strict=True))
    axis, near_side = _ray_facing_axes(labels)
    along = (part["far_end"] - part["near_end"]) / 2
    across = near_side * (part["near_side"] - part["far_side"]) / 2
    heading = np.deg2rad(part["heading_deg"])
    quarter = np.where(np.abs(heading) > np.pi / 4, -np.sign(heading) * np.pi / 2, 0.0)
    boxes = labels.copy()
    boxes[:, 0] += along * axis[:, 0] - across * axis[:, 1]
    boxes[:, 1] += along * axis[:, 1] + across * axis[:, 0]
    boxes[:, 2] += (part["bottom"] + part["top"]) / 2
    boxes[:, 3] += part["near_end"] + part["far_end"]
    boxes[:, 4] += part["near_side"] + part["far_side"]
    boxes[:, 5] += part["top"] - part["bottom"]
    boxes[:, 3:6] = np.maximum(boxes[:, 3:6], _MIN_SIZE_M)
    boxes[:, 6] = wrap_angle(labels[:, 6] + heading + quarter + np.pi * part["turned"])
    return boxes


def corrected(labels: Floats, residuals: Floats, part: str) -> Floats:
    """Return the boxes (K, 7) of these residuals with one part, a key of CORRECTIONS, set to the labels' (K, 7)."""
    kept = residuals.copy()
    kept[:, list(CORRECTIONS[part])] = 0.0
    return boxes_from_residuals(labels, kept)


def _ray_facing_axes(labels: Floats) -> tuple[Floats, Floats]:
    """Return unit vectors (K, 2) of the labels' ray-facing axes, and the sensor's side of them: (K,), 1 is left."""
    heading = np.stack([np.cos(labels[:, 6]), np.sin(labels[:, 6])], axis=1)
    axis = np.where((heading * labels[:, :2]).sum(axis=1, keepdims=True) < 0, -heading, heading)
    sensor_left = labels[:, 0] * axis[:, 1] - labels[:, 1] * axis[:, 0]
    return axis, np.where(sensor_left < 0, -1.0, 1.0)


def _match(overlap: Floats, detections: Mask, objects: Mask, least: float) -> Ints:
    """Match some detections with some objects by (D, M) overlaps: (M,) detection of each object, or _NONE."""
    rows, columns = np.flatnonzero(detections), np.flatnonzero(objects)
    matched, items = match_by_overlap(overlap[np.ix_(rows, columns)], least)
    match = np.full(overlap.shape[1], _NONE)
    match[columns[items]] = rows[matched]
    return match


def _false_kind(overlap: Floats, types: NDArray[np.object_], related: Mask, least: float) -> tuple[str, str]:
    """Return the kind of a false positive and the type of the overlapped label, from its overlaps (M,)."""
    for chosen, low, kind in (
        (related, least, "duplicate"),
        (related, LOCALIZATION_IOU, "localization"),
        (~related, LOCALIZATION_IOU, "classification"),
    ):
        touching = np.where(chosen, overlap, 0.0)
        if touching.max(initial=0.0) >= low:
            return kind, str(types[touching.argmax()])
    return "background", ""


def _nearest_m(boxes: Floats, mask: Mask) -> Floats:
    """Return the distance (M,) from each box (M, 7) to the nearest other one in a mask (M,); infinite without one."""
    apart = np.linalg.norm(boxes[:, None, :2] - boxes[None, :, :2], axis=2)
    np.fill_diagonal(apart, np.inf)
    return np.where(mask, apart, np.inf).min(axis=1, initial=np.inf)


FEW_POINTS = 20
TALL_M = 2.3
LOW_M = 1.2
BRIGHT_REFLECTANCE = 0.5
BRIGHT_SHARE = 0.25
HOLLOW_SHARE = 0.05
LONG_M = 5.0
_FOOT_M = 0.2  # lower points may be of the ground
_MARGIN_M = 0.1
_BESIDE_M = 1.0
_AROUND_M = 12.0

TRAITS = {
    "few points": f"fewer than {FEW_POINTS} points in the box",
    "tall": f"points above the box to more than {TALL_M:g} m above the ground",
    "low": f"no point higher than {LOW_M:g} m above the ground",
    "bright": f"{BRIGHT_SHARE:.0%} of its points or more with a reflectance of {BRIGHT_REFLECTANCE:g} or more",
    "beside": f"as many points within {_BESIDE_M:g} m beside it, at its height, as in it",
    "attached": f"what it stands on is joined to points over more than {LONG_M:g} m",
    "hollow": f"at most {HOLLOW_SHARE:.0%} of its points in the middle half of its length and width",
}


@dataclass(frozen=True)
class Surroundings:
    """Statistics of the points at a detection. Metres; NaN without points above the ground.

    Attributes:
        distance_m: horizontal distance of the box's center.
        points: number in the box, widened by 0.1 m, above the ground.
        top_m: highest point above the ground over the footprint, also above the box.
        bottom_m: lowest point.
        box_top_m: top of the box, above the ground.
        reflectance: mean of the points in the box.
        bright: share of those with at least BRIGHT_REFLECTANCE.
        beside: number of points beside the box, at its height, per point in it.
        cluster_length_m, cluster_width_m: size of the rectangle around the cluster of its points.
        middle: share of its points in the middle half of length and width.
    """

    distance_m: float
    points: int
    top_m: float
    bottom_m: float
    box_top_m: float
    reflectance: float
    bright: float
    beside: float
    cluster_length_m: float
    cluster_width_m: float
    middle: float

    @property
    def traits(self) -> tuple[str, ...]:
        """Keys of TRAITS that hold."""
        holds = {
            "few points": self.points < FEW_POINTS,
            "tall": self.top_m > TALL_M,
            "low": self.top_m < LOW_M,
            "bright": self.bright >= BRIGHT_SHARE,
            "beside": self.beside >= 1,
            "attached": self.cluster_length_m > LONG_M,
            "hollow": self.middle <= HOLLOW_SHARE,
        }
        return tuple(name for name in TRAITS if holds[name])


def describe(
    points: NDArray[np.float32], ground: Ground | None, boxes: Sequence[NDArray[np.float64]]
) -> list[Surroundings]:
    """Describe the surroundings of K boxes (7,) in a scan (N, 4), metres, the sensor at the origin.

    Args:
        points: x, y, z, reflectance.
        ground: `data.insertion.ground_fit.fit_ground` of the points; without it the ground is each box's own bottom.
        boxes: boxes of detections.
    """
    return [_describe_one(points, ground, box) for box in boxes]


def _describe_one(points: NDArray[np.float32], ground: Ground | None, box: NDArray[np.float64]) -> Surroundings:
    x, y, z, length, width, height, yaw = box
    close = points[(np.abs(points[:, 0] - x) < _AROUND_M) & (np.abs(points[:, 1] - y) < _AROUND_M)].astype(np.float64)
    floor = z - height / 2 if ground is None else float(ground.heights(box[None, :2])[0])
    above = close[:, 2] - (floor if ground is None else ground.heights(close[:, :2]))
    close, above = close[above > _FOOT_M], above[above > _FOOT_M]
    offset = close[:, :2] - (x, y)
    along = np.abs(offset @ (np.cos(yaw), np.sin(yaw)))
    across = np.abs(offset @ (-np.sin(yaw), np.cos(yaw)))
    top = z + height / 2 - floor
    over = (along < length / 2 + _MARGIN_M) & (across < width / 2 + _MARGIN_M)
    at_height = above < top + _MARGIN_M
    inside = over & at_height
    ring = (along < length / 2 + _BESIDE_M) & (across < width / 2 + _BESIDE_M) & ~over & at_height
    count = int(inside.sum())
    distance = float(np.hypot(x, y))
    if not count:
        return Surroundings(distance, 0, np.nan, np.nan, top, np.nan, np.nan, np.nan, np.nan, np.nan, np.nan)
    middle = inside & (along < length / 4) & (across < width / 4)
    extent = _joined_extent(offset, inside)
    bright = float(np.mean(close[inside, 3] >= BRIGHT_REFLECTANCE))
    return Surroundings(
        distance,
        count,
        float(above[over].max()),
        float(above[over].min()),
        top,
        float(close[inside, 3].mean()),
        bright,
        float(ring.sum() / count),
        *extent,
        float(middle.sum() / count),
    )


def _joined_extent(offset: NDArray[np.float64], inside: NDArray[np.bool_]) -> tuple[float, float]:
    """Return length and width, metres, of the cluster with most points (N,) of a box, among points (N, 2)."""
    labels = cluster_labels(offset)
    main_cluster = np.bincount(labels[inside]).argmax()
    joined = offset[labels == main_cluster] if main_cluster else offset[inside]
    centered = joined - joined.mean(axis=0)
    _, axes = np.linalg.eigh(centered.T @ centered)
    width, length = np.ptp(centered @ axes, axis=0)
    return float(length), float(width)
