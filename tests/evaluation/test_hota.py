"""HOTA on cases by hand, and against a twin that tries every matching and counts every set as the paper writes it."""

from itertools import permutations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from asca_pillars.evaluation.tracking_metrics import ALPHAS, TrackedFrame, hota
from tests.evaluation.tracked_frames import frame


def twin(frames: list[TrackedFrame]) -> list[float]:
    """HOTA at every threshold: all one-to-one matchings of each frame, all sets of pairs."""
    labels, found = (
        [int(i) for f in frames for i in side(f)] for side in (lambda f: f.objects, lambda f: f.detections)
    )
    values = []
    for alpha in ALPHAS:
        could = [f.similarity >= alpha - 1e-9 for f in frames]
        near = [(f, i, j) for f, own in zip(frames, could, strict=True) for i, j in np.argwhere(own)]
        everywhere = [(int(f.objects[i]), int(f.detections[j])) for f, i, j in near]

        def association(pair: tuple[int, int], pairs: list[tuple[int, int]]) -> float:
            tpa = pairs.count(pair)
            return tpa / (labels.count(pair[0]) + found.count(pair[1]) - tpa)

        matches: list[tuple[int, int]] = []
        for f, own in zip(frames, could, strict=True):
            n, m = own.shape
            best: tuple[tuple[float, ...], list[tuple[int, int]]] = ((-1.0,), [])
            for way in permutations(range(m + n), n):  # columns from m on stand for no match
                places = [(row, column) for row, column in enumerate(way) if column < m and own[row, column]]
                pairs = [(int(f.objects[row]), int(f.detections[column])) for row, column in places]
                close = sum(association(pair, everywhere) for pair in pairs)
                close += 1e-3 * sum(f.similarity[place] for place in places)
                best = max(best, ((float(len(pairs)), close), pairs), key=lambda one: one[0])
            matches += best[1]
        total = sum(association(pair, matches) for pair in matches)
        values.append((total / (len(labels) + len(found) - len(matches))) ** 0.5)
    return values


def test_hota_by_hand() -> None:
    frames = [frame([1, 2], [1, 2]), frame([2, 1], [2, 1]), frame([2], [2])]
    assert hota([frames]) == (1.0, 1.0, 1.0, 1.0)
    # Four frames, found as 1, 1, 2, 2. Each match: TPA 2, FNA 2, FPA 0, so A = 1/2; DetA = 1.
    score = hota([[frame([0], [one], [[1.0]]) for one in (1, 1, 2, 2)]])
    assert score.det_a == 1.0 and score.ass_a == pytest.approx(0.5) and score.hota == pytest.approx(0.5**0.5)
    # 0.5 reaches ten of the nineteen thresholds, 0.05 to 0.5.
    score = hota([[frame([0], [0], [[0.5]])] * 3])
    assert score.hota == pytest.approx(10 / 19)
    assert score.loc_a == pytest.approx((10 * 0.5 + 9 * 1.0) / 19)
    one = [frame([0], [0])] * 2
    assert hota([one, [frame([0], [1])._replace(similarity=np.array([[1.0]]))] * 2]).hota == 1.0
    assert np.isnan(hota([[frame([], [])]]).hota)
    assert hota([[frame([1], [])]]).hota == 0.0
    assert hota([[frame([], [1])]]).hota == 0.0


@settings(max_examples=40)
@given(st.integers(0, 10_000))
def test_against_the_twin(seed: int) -> None:
    rng = np.random.default_rng(seed)
    frames = []
    for _ in range(int(rng.integers(1, 5))):
        objects = rng.permutation(3)[: rng.integers(0, 4)]
        found = 10 + rng.permutation(3)[: rng.integers(0, 4)]
        # Distinct values, so that the best matching is one.
        frames.append(frame(objects.tolist(), found.tolist(), rng.random((len(objects), len(found)))))
    if sum(len(f.objects) + len(f.detections) for f in frames):
        assert hota([frames]).hota == pytest.approx(np.mean(twin(frames)), abs=1e-9)
