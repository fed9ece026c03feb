"""What becomes of every object and every detection when only detections of at least some score are reported.

An object is counted or, beyond a limit of the difficulty or of a neighboring type, ignored, as KITTI has it (`states`).
Each reported detection, the best first, takes the free object of its class, counted or ignored, that it overlaps most,
if that is more than the minimum. A counted object that was taken is found, and its detection true.

A detection that took nothing is false unless it is excused: lower in the image than the difficulty asks for (objects
so low need no label; nor do those outside the image, where detections have no 2D box), or more than half of its 2D box
in one DontCare area. One that took an ignored object is neither true nor false.

This departs from KITTI's AP, which ranks by score over the whole set: there the objects choose among the detections, an
object taken by a low detection (of whatever class) is neither found nor missed, DontCare areas excuse in 2D only, and
what lies outside a distance band is ignored.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from asca_pillars.evaluation.assignment import greedy_matches
from asca_pillars.evaluation.kitti.average_precision import min_overlap as kitti_min_overlap
from asca_pillars.evaluation.kitti.objects import FrameObjects
from asca_pillars.evaluation.kitti.pairs import Frames, Pairs, dont_care_shares, overlapping_pairs
from asca_pillars.evaluation.kitti.states import (
    ABSENT,
    COUNTED,
    IGNORED,
    detection_states,
    is_neighbor,
    is_type,
    truth_states,
)

EXCUSING_SHARE = 0.5

_Mask = NDArray[np.bool_]


@dataclass(frozen=True, eq=False)
class Verdict:
    """What became of a frame's N objects and D detections.

    Attributes:
        counted, found: (N,) objects that are to be found, and those of them that were.
        reported, true, false: (D,) detections that reach the score, those that found a counted object, those that
            found nothing and are not excused.
    """

    frame_id: str
    counted: _Mask
    found: _Mask
    reported: _Mask
    true: _Mask
    false: _Mask

    @property
    def missed(self) -> _Mask:
        """(N,) counted objects that were not found."""
        return self.counted & ~self.found

    @property
    def uncounted(self) -> _Mask:
        """(N,) objects that need not be found."""
        return ~self.counted

    @property
    def excused(self) -> _Mask:
        """(D,) reported detections that are neither true nor false."""
        return self.reported & ~self.true & ~self.false

    @property
    def errors(self) -> int:
        """Objects missed and false detections."""
        return int(self.missed.sum() + self.false.sum())


def verdicts(
    truth: Sequence[FrameObjects],
    detections: Sequence[FrameObjects],
    class_names: Sequence[str],
    *,
    scores: Mapping[str, float] | float,
) -> list[Verdict]:
    """What stands behind `operating_points`, frame by frame: all classes together, moderate, in 3D.

    Raises:
        ValueError: the frames differ, or `scores` lacks a class.
    """
    scene = Scene.of(truth, detections, class_names, scores, None)
    judged = [judge(scene, name, "moderate", "3d") for name in class_names]
    starts = np.cumsum([0, *(len(frame) for frame in truth)])[:-1], scene.frames.detection_starts[:-1]
    parts = [
        np.split(np.any([getattr(verdict, name) for verdict in judged], axis=0), starts[side])[1:]
        for name, side in (("counted", 0), ("found", 0), ("reported", 1), ("true", 1), ("false", 1))
    ]
    return [Verdict(frame.frame_id, *masks) for frame, *masks in zip(truth, *parts, strict=True)]


@dataclass(frozen=True, eq=False)
class Scene:
    """All frames, and what depends on no difficulty: which pairs overlap, who lies in a DontCare area.

    Raises:
        ValueError: from `of`, if the frames differ, or `scores` or `min_overlap` lacks a class.
    """

    frames: Frames
    pairs: Pairs
    in_dont_care: _Mask
    scores: Mapping[str, float]
    min_overlap: Mapping[str, float]

    @classmethod
    def of(
        cls,
        truth: Sequence[FrameObjects],
        detections: Sequence[FrameObjects],
        class_names: Sequence[str],
        scores: Mapping[str, float] | float,
        min_overlap: Mapping[str, float] | None,
    ) -> "Scene":
        if [frame.frame_id for frame in truth] != [frame.frame_id for frame in detections]:
            raise ValueError("ground truth and detections must be of the same frames, in the same order")
        if min_overlap is None:
            min_overlap = {name: kitti_min_overlap(name) for name in class_names}
        if not isinstance(scores, Mapping):
            scores = dict.fromkeys(class_names, float(scores))
        if missing := [name for name in class_names if name not in min_overlap or name not in scores]:
            raise ValueError(f"no score or no minimum overlap is given for {', '.join(missing)}")
        frames = Frames.join(truth, detections)
        related = [is_type(frames.truth, name) | is_neighbor(frames.truth, name) for name in class_names]
        lowest = min(min_overlap[name] for name in class_names)
        pairs = overlapping_pairs(frames, np.any(related, axis=0), lowest)
        return cls(frames, pairs, dont_care_shares(frames) > EXCUSING_SHARE, scores, min_overlap)


def judge(scene: Scene, class_name: str, difficulty: str, metric: str) -> Verdict:
    """The verdict on one class in all frames, as if they were one."""
    objects, detections = scene.frames.truth, scene.frames.detections
    states = truth_states(objects, class_name, difficulty)
    reported = is_type(detections, class_name) & (detections.scores >= scene.scores[class_name])
    pairs = scene.pairs
    able = (states[pairs.truth] != ABSENT) & reported[pairs.detection]
    pairs = pairs.where(able & (pairs.overlaps[metric] > scene.min_overlap[class_name]))
    best = np.lexsort((-pairs.overlaps[metric], pairs.detection, -detections.scores[pairs.detection]))
    matched = best[greedy_matches(pairs.detection[best], pairs.truth[best])]

    counted = states == COUNTED
    hits = matched[counted[pairs.truth[matched]]]
    found, true = np.zeros_like(counted), np.zeros_like(reported)
    found[pairs.truth[hits]] = True
    true[pairs.detection[hits]] = True
    low = detection_states(detections, class_name, difficulty) == IGNORED
    false = reported & ~low & ~scene.in_dont_care
    false[pairs.detection[matched]] = False
    return Verdict("", counted, found, reported, true, false)
