"""`decode` against a plain loop over anchors, suppression against its definition, and maps of nothing or nonsense."""

import dataclasses
import math

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from asca_pillars.base.errors import ConfigError
from asca_pillars.detection.anchors import KITTI_CLASSES, ClassSpec, make_anchors
from asca_pillars.detection.decode import HeadMaps, PostProcess, decode, rotated_nms, vote_boxes
from asca_pillars.geometry.boxes import decode_boxes, encode_boxes
from asca_pillars.geometry.overlap import bev_iou
from asca_pillars.ops.pillar.grid import PillarGrid
from tests.geometry.overlap_oracles import bev_iou_twin, random_boxes

GRID = PillarGrid(x_range_m=(2.0, 17.36), y_range_m=(-3.2, 7.04), z_range_m=(-2.5, 1.5))
CLASSES = tuple(
    dataclasses.replace(spec, score_threshold=score) for spec, score in zip(KITTI_CLASSES, (0.5, 0.3, 0.4), strict=True)
)
ANCHORS = make_anchors(*GRID.head_centers_m(), CLASSES)
HEIGHT, WIDTH, COUNT, _ = ANCHORS.shape
NAMES = ("Car", "Pedestrian", "Cyclist")


def quiet_maps() -> HeadMaps:
    """Head maps in which every anchor says no."""
    return HeadMaps(
        scores=np.full((COUNT, HEIGHT, WIDTH), -10.0, np.float32),
        boxes=np.zeros((7 * COUNT, HEIGHT, WIDTH), np.float32),
        directions=np.zeros((2 * COUNT, HEIGHT, WIDTH), np.float32),
    )


def write(maps: HeadMaps, anchor: int, row: int, column: int, box: np.ndarray, logit: float) -> None:
    """Let one anchor report a box."""
    residuals, direction = encode_boxes(box, ANCHORS[row, column, anchor])
    maps.scores[anchor, row, column] = logit
    maps.boxes[7 * anchor : 7 * anchor + 7, row, column] = residuals
    maps.directions[2 * anchor + direction, row, column] = 1.0


def noisy_maps(seed: int, mean_logit: float) -> HeadMaps:
    rng = np.random.default_rng(seed)
    return HeadMaps(
        scores=rng.normal(mean_logit, 2.0, (COUNT, HEIGHT, WIDTH)).astype(np.float32),
        boxes=rng.normal(0, 0.3, (7 * COUNT, HEIGHT, WIDTH)).astype(np.float32),
        directions=rng.normal(0, 1, (2 * COUNT, HEIGHT, WIDTH)).astype(np.float32),
    )


def decode_twin(maps: HeadMaps, post: PostProcess) -> list[tuple[float, int, np.ndarray]]:
    """(logit, label, box) of each detection, best first: one anchor at a time, no shortcuts."""
    reported = []
    for label, spec in enumerate(CLASSES):
        found = []
        for anchor, row, column in np.argwhere(maps.scores[2 * label : 2 * label + 2] >= -9).tolist():
            anchor += 2 * label
            logit = float(maps.scores[anchor, row, column])
            if 1 / (1 + math.exp(-logit)) >= spec.score_threshold:
                residuals = maps.boxes[7 * anchor : 7 * anchor + 7, row, column]
                direction = maps.directions[2 * anchor : 2 * anchor + 2, row, column].argmax()
                found.append((logit, label, decode_boxes(residuals, direction, ANCHORS[row, column, anchor])))
        found = sorted(found, key=lambda item: -item[0])[: post.candidates]
        kept: list[tuple[float, int, np.ndarray]] = []
        for item in found:
            better = np.array([other[2] for other in kept], np.float32).reshape(-1, 7)
            if (bev_iou(item[2][None], better) <= post.nms_iou).all():
                kept.append(item)
        reported += kept
    return sorted(reported, key=lambda item: -item[0])[: post.max_detections]


@settings(max_examples=15)
@given(
    st.integers(0, 2**32 - 1),
    st.sampled_from([-6.0, -4.0]),
    st.sampled_from([0.01, 0.3]),
    st.sampled_from([20, 1000]),
    st.sampled_from([5, 100]),
    st.booleans(),
    st.booleans(),
)
@example(0, -4.0, 0.3, 20, 100, False, False)  # more anchors than candidates
@example(1, -4.0, 0.3, 20, 100, True, True)  # and equal ones among the last to get in
def test_equals_a_plain_loop(
    seed: int, mean_logit: float, nms_iou: float, candidates: int, max_detections: int, ties: bool, channels_last: bool
) -> None:
    maps, post = noisy_maps(seed, mean_logit), PostProcess(nms_iou, candidates, max_detections)
    if ties:
        maps = maps._replace(scores=np.round(maps.scores))
    if channels_last:  # as the backbone leaves them
        maps = HeadMaps(*(np.moveaxis(np.moveaxis(m, 0, -1).copy(), -1, 0) for m in maps))
    detections = decode(maps, ANCHORS, CLASSES, post)
    expected = decode_twin(maps, post)
    assert detections.labels.tolist() == [label for _, label, _ in expected]
    np.testing.assert_allclose(detections.scores, [1 / (1 + math.exp(-x)) for x, _, _ in expected], rtol=1e-6)
    np.testing.assert_array_equal(detections.boxes, np.reshape([box for _, _, box in expected], (-1, 7)))
    assert detections.class_names == NAMES
    kinds = (detections.boxes.dtype, detections.scores.dtype, detections.labels.dtype)
    assert kinds == (np.float32, np.float32, np.int64)


def all_of(threshold: float) -> tuple[ClassSpec, ...]:
    return tuple(dataclasses.replace(spec, score_threshold=threshold) for spec in CLASSES)


def test_thresholds_of_zero_and_one() -> None:
    """Cells that a masked neck never looks at, at -10^4, are not reported at 0; 10^4 does not overflow."""
    assert len(decode(quiet_maps(), ANCHORS, all_of(0.0), PostProcess())) == 100
    assert len(decode(quiet_maps(), ANCHORS, all_of(1.0), PostProcess())) == 0
    maps = quiet_maps()
    maps.scores[:] = -1e4
    write(maps, 0, 5, 10, ANCHORS[5, 10, 0], -20.0)
    assert len(decode(maps, ANCHORS, all_of(0.0), PostProcess())) == 1
    write(maps, 0, 20, 12, ANCHORS[20, 12, 0], 1e4)
    assert decode(maps, ANCHORS, all_of(0.0), PostProcess()).scores[0] == 1


def test_numbers_that_overflowed_give_no_boxes() -> None:
    maps = quiet_maps()
    good = np.array([9.1, 3.3, -0.9, 4.2, 1.7, 1.5, 0.2], np.float32)
    write(maps, 0, 20, 12, good, 0.5)
    maps.scores[0, 0, :4] = 5.0
    maps.boxes[0, 0, 0] = np.inf  # x of anchor 0
    maps.boxes[3, 0, 1] = np.nan  # length
    maps.boxes[6, 0, 2] = -np.inf  # yaw
    maps.boxes[4, 0, 3] = 200.0  # width: exp(200) is infinite in float32, and is held back
    maps.scores[1, 0, 0] = np.nan
    maps.scores[0, 0, 4] = 5.0
    maps.boxes[1, 0, 4] = 3e38  # y: beyond float32 once multiplied by the diagonal
    detections = decode(maps, ANCHORS, CLASSES, PostProcess(nms_iou=1.0))
    assert np.isfinite(detections.boxes).all()
    np.testing.assert_allclose(detections.boxes[:, 4], [160, 1.7], rtol=1e-5)


@pytest.mark.parametrize("settings", [{"nms_iou": -0.1}, {"nms_iou": 1.1}, {"candidates": 0}, {"max_detections": 0}])
def test_impossible_settings_are_refused(settings: dict[str, float]) -> None:
    with pytest.raises(ConfigError, match=next(iter(settings))):
        PostProcess(**settings)  # type: ignore[arg-type]


@settings(max_examples=15)
@given(st.integers(0, 2**32 - 1), st.sampled_from([0.0, 0.1, 1.0]))
def test_rows_of_active_cells_decode_as_maps_in_which_the_others_say_no(seed: int, share: float) -> None:
    maps, quiet = noisy_maps(seed, -1.0), quiet_maps()
    cells = np.flatnonzero(np.random.default_rng(seed).random(HEIGHT * WIDTH) < share)
    for part, silent in zip(maps, quiet, strict=True):
        silent.reshape(len(part), -1)[:, cells] = part.reshape(len(part), -1)[:, cells]
    rows = HeadMaps(*(np.ascontiguousarray(part.reshape(len(part), -1)[:, cells].T) for part in maps))
    expected = decode(quiet, ANCHORS, CLASSES, PostProcess())
    found = decode(rows, ANCHORS, CLASSES, PostProcess(), cells)
    for part in ("boxes", "scores", "labels"):
        np.testing.assert_array_equal(getattr(found, part), getattr(expected, part))
    with pytest.raises(ValueError, match="must have shapes"):
        decode(rows, ANCHORS, CLASSES, PostProcess(), np.arange(len(cells) + 1))


def nms_twin(boxes: np.ndarray, scores: np.ndarray, threshold: float) -> list[int]:
    """The definition: walk down the scores, keep what no kept box overlaps too much; by shapely if they may meet."""
    reach = np.hypot(boxes[:, 3], boxes[:, 4]) / 2
    kept: list[int] = []
    for index in sorted(range(len(boxes)), key=lambda i: -scores[i]):
        apart = np.hypot(*(boxes[kept, :2] - boxes[index, :2]).T)
        near = np.flatnonzero(apart < reach[kept] + reach[index])
        if all(bev_iou_twin(boxes[index], boxes[kept[other]]) <= threshold for other in near):
            kept.append(index)
    return kept


@settings(max_examples=20)
@given(
    st.integers(0, 2**32 - 1),
    st.integers(0, 100),
    st.sampled_from([2.0, 10.0, 40.0]),
    st.sampled_from([0.01, 0.2, 0.5, 0.8]),
    st.booleans(),
)
def test_suppression_equals_its_definition(
    seed: int, count: int, spread_m: float, threshold: float, ties: bool
) -> None:
    boxes = random_boxes(seed, count, spread_m).astype(np.float64)
    scores = np.random.default_rng(seed).normal(size=count)
    if ties:
        scores = np.round(scores)
    kept = rotated_nms(boxes, scores, threshold)
    assert kept.dtype == np.int64
    assert kept.tolist() == nms_twin(boxes, scores, threshold)


def vote_twin(boxes: np.ndarray, scores: np.ndarray, labels: np.ndarray, kept: int, threshold: float) -> np.ndarray:
    """The weighted mean of one kept box's voters, by `bev_iou`; its heading as an angle of a line."""
    overlaps = bev_iou(boxes[[kept]], boxes)[0]
    voters = np.flatnonzero((labels == labels[kept]) & (overlaps >= threshold))
    weights = scores[voters] ** 2 * overlaps[voters]
    mean = weights @ boxes[voters].astype(np.float64) / weights.sum()
    turns = [math.remainder(boxes[voter, 6] - boxes[kept, 6], math.pi) for voter in voters]
    mean[6] = math.remainder(boxes[kept, 6] + weights @ turns / weights.sum(), 2 * math.pi)
    return mean


@given(st.integers(0, 2**32 - 1), st.integers(1, 30), st.sampled_from([0.2, 0.5, 0.8]))
@settings(max_examples=60, deadline=None)
def test_votes_are_weighted_means_of_overlapping_boxes_of_a_class(seed: int, count: int, threshold: float) -> None:
    rng = np.random.default_rng(seed)
    boxes = np.repeat(random_boxes(seed, max(1, count // 5), 10.0), 5, axis=0)[:count]
    boxes = (boxes + rng.normal(0, 0.1, boxes.shape)).astype(np.float32)
    boxes[:, 3:6] = np.abs(boxes[:, 3:6]) + 0.5
    boxes[:, 6] += math.pi * rng.integers(-1, 2, len(boxes))
    scores, labels = rng.uniform(0.1, 1, len(boxes)).astype(np.float32), rng.integers(0, 2, len(boxes))
    kept = rng.permutation(len(boxes))[:4]
    overlaps = bev_iou(boxes[kept], boxes)
    turns = np.abs([[math.remainder(b[6] - boxes[k, 6], math.pi) for b in boxes] for k in kept])
    if (np.abs(overlaps - threshold) < 1e-6).any() or (np.abs(turns - math.pi / 2) < 1e-4).any():
        return  # a tie, which rounding decides
    voted = vote_boxes(boxes, scores, labels, kept, threshold)
    expected = np.array([vote_twin(boxes, scores, labels, row, threshold) for row in kept])
    np.testing.assert_allclose(voted[:, :6], expected[:, :6], atol=1e-4)
    np.testing.assert_allclose(np.cos(voted[:, 6] - expected[:, 6]), 1, atol=1e-6)
    assert (np.abs(voted[:, 6]) <= math.pi).all()


def test_only_with_votes_does_suppression_change_a_box() -> None:
    """Two anchors that see one car 0.4 m apart: the better one is reported, in between with votes."""
    maps, center = quiet_maps(), ANCHORS[HEIGHT // 2, WIDTH // 2, 0].astype(np.float64)
    other = center + np.eye(7)[0] * 0.4
    write(maps, 0, HEIGHT // 2, WIDTH // 2, center, 2.0)
    write(maps, 0, HEIGHT // 2, WIDTH // 2 + 1, other, 1.0)
    (alone,), (voted,) = (
        decode(maps, ANCHORS, CLASSES, PostProcess(vote_iou=vote_iou)).boxes for vote_iou in (None, 0.6)
    )
    np.testing.assert_allclose(alone, center, atol=1e-5)
    overlap = bev_iou(center[None], other[None])[0, 0]
    weights = np.array([1 / (1 + math.exp(-2)) ** 2, overlap / (1 + math.exp(-1)) ** 2])
    np.testing.assert_allclose(voted[0] - center[0], 0.4 * weights[1] / weights.sum(), atol=1e-5)
    np.testing.assert_allclose(voted[1:], center[1:], atol=1e-5)
    lower, higher = (dataclasses.replace(CLASSES[0], score_threshold=score) for score in (0.2, 0.85))
    (reported,) = decode(maps, ANCHORS, (higher, *CLASSES[1:]), PostProcess(vote_iou=0.6)).boxes
    (both,) = decode(maps, ANCHORS, (lower, *CLASSES[1:]), PostProcess(vote_iou=0.6)).boxes
    np.testing.assert_array_equal([reported, both], [voted, voted])  # the other anchor votes without being reported
    with pytest.raises(ConfigError, match=r"vote_iou 1\.5 must lie between 0 and 1"):
        PostProcess(vote_iou=1.5)
