"""The figures of TrackEval on random sequences; runs where `trackeval` is installed (`pip install trackeval`)."""

from collections.abc import Sequence

import numpy as np
import pytest

from asca_pillars.evaluation.tracking_metrics import TrackedFrame, clear_mot, hota
from asca_pillars.geometry.overlap import iou_3d

trackeval_clear = pytest.importorskip("trackeval.metrics.clear")
trackeval_hota = pytest.importorskip("trackeval.metrics.hota")
MIN_IOU = 0.25


def sequence(seed: int, frames: int) -> list[TrackedFrame]:
    """Objects that drive among each other, found with jitter, gaps and exchanged identities; none absent."""
    rng = np.random.default_rng(seed)
    count = int(rng.integers(3, 7))
    boxes = np.tile([0, 0, 0, 4, 2, 1.5, 0.0], (count, 1))
    boxes[:, :2] = rng.uniform(0, 6, (count, 2))
    speed, identities, result = rng.normal(0, 0.5, (count, 2)), np.arange(count), []
    for _ in range(frames):
        boxes[:, :2] += speed
        if rng.random() < 0.15:
            identities = rng.permutation(count)
        rows = np.flatnonzero(rng.random(count) > 0.15)
        rows = rows if len(rows) else np.array([0])
        found = boxes[rows] + rng.normal(0, 0.4, (len(rows), 7)) * [1, 1, 0, 0, 0, 0, 0]
        result.append(TrackedFrame(np.arange(count), 100 + identities[rows], iou_3d(boxes, found)))
    return result


@pytest.mark.parametrize("frames", [4, 12, 150])
def test_clear_is_equal_and_hota_close(frames: int) -> None:
    """HOTA differs where a frame's best matching is another one at another threshold; the longer, the less."""
    worst = 0.0
    for seed in range(10):
        own = sequence(seed, frames)
        data = trackeval_data(own)
        clear = trackeval_clear.CLEAR({"THRESHOLD": MIN_IOU, "PRINT_CONFIG": False}).eval_sequence(data)
        ours = clear_mot([own], MIN_IOU)
        assert ours.mota == pytest.approx(clear["MOTA"], abs=1e-9)
        counts = ours.matches, ours.false_boxes, ours.identity_switches, ours.fragmentations
        assert counts == (clear["CLR_TP"], clear["CLR_FP"], clear["IDSW"], clear["Frag"])
        worst = max(worst, abs(hota([own]).hota - np.mean(trackeval_hota.HOTA().eval_sequence(data)["HOTA"])))
    assert worst < (0.005 if frames == 150 else 0.07)


def test_fragmentations_differ_as_documented() -> None:
    """An object that is not labelled for a while, and a frame in which nothing at all is found."""
    pair = TrackedFrame(np.array([0, 1]), np.array([5, 6]), np.eye(2))
    absent = TrackedFrame(np.array([1]), np.array([6]), np.ones((1, 1)))
    empty = TrackedFrame(np.array([0, 1]), np.array([], np.int64), np.zeros((2, 0)))
    for middle, ours, theirs in ((absent, 0, 1), (empty, 2, 0)):
        frames = [pair, middle, pair]
        clear = trackeval_clear.CLEAR({"PRINT_CONFIG": False}).eval_sequence(trackeval_data(frames))
        assert (clear_mot([frames], 0.5).fragmentations, clear["Frag"]) == (ours, theirs)


def trackeval_data(frames: Sequence[TrackedFrame]) -> dict[str, object]:
    objects = np.unique(np.concatenate([frame.objects for frame in frames]))
    found = np.unique(np.concatenate([frame.detections for frame in frames]))
    return {
        "num_timesteps": len(frames),
        "num_gt_ids": len(objects),
        "num_tracker_ids": len(found),
        "num_gt_dets": sum(len(frame.objects) for frame in frames),
        "num_tracker_dets": sum(len(frame.detections) for frame in frames),
        "gt_ids": [np.searchsorted(objects, frame.objects) for frame in frames],
        "tracker_ids": [np.searchsorted(found, frame.detections) for frame in frames],
        "similarity_scores": [frame.similarity for frame in frames],
    }
