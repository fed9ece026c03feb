"""HOTA on cases by hand, and against a twin that tries every matching and counts every set as the paper writes it."""

from itertools import permutations, product

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from asca_pillars.evaluation.tracking.tracking_metrics import ALPHAS, TrackedFrame, hota
from tests.evaluation.tracking.tracked_frames import frame


def twin(frames: list[TrackedFrame]) -> list[float]:
    """HOTA at every threshold: all one-to-one matchings of each frame, all sets of pairs."""
    boxes = [(t, "label", int(i)) for t, f in enumerate(frames) for i in f.objects]
    boxes += [(t, "found", int(j)) for t, f in enumerate(frames) for j in f.found]
    values = []
    for alpha in ALPHAS:

        def could(f: TrackedFrame, row: int, column: int, alpha: float = alpha) -> bool:
            return f.similarity[row, column] >= alpha - 1e-9

        everywhere = [
            (int(i), int(j))
            for f in frames
            for (row, i), (column, j) in product(enumerate(f.objects), enumerate(f.found))
            if could(f, row, column)
        ]

        def association(i: int, j: int, pairs: list[tuple[int, int]]) -> float:
            tpa = pairs.count((i, j))
            fna = sum(kind == "label" and number == i for _, kind, number in boxes) - tpa
            fpa = sum(kind == "found" and number == j for _, kind, number in boxes) - tpa
            return tpa / (tpa + fna + fpa)

        matches: list[tuple[int, int]] = []
        for f in frames:
            n, m = len(f.objects), len(f.found)
            best: tuple[tuple[float, ...], list[tuple[int, int]]] = ((-1.0,), [])
            for way in permutations(range(m + n), n):  # columns from m on stand for no match
                pairs = [(row, column) for row, column in enumerate(way) if column < m and could(f, row, column)]
                numbers = [(int(f.objects[row]), int(f.found[column])) for row, column in pairs]
                worth = (
                    float(len(pairs)),
                    sum(association(i, j, everywhere) + 1e-3 * f.similarity[p] for (i, j), p in zip(numbers, pairs)),  # noqa: B905
                )
                if worth > best[0]:
                    best = worth, numbers
            matches += best[1]
        total = sum(association(i, j, matches) for i, j in matches)
        values.append((total / (len(boxes) - len(matches))) ** 0.5)
    return values


def test_labels_against_themselves_are_perfect() -> None:
    frames = [frame([1, 2], [1, 2]), frame([2, 1], [2, 1]), frame([2], [2])]
    assert hota([frames]) == (1.0, 1.0, 1.0, 1.0)


def test_a_switch_in_the_middle() -> None:
    # Four frames, found as 1, 1, 2, 2. Each match: TPA 2, FNA 2, FPA 0, so A = 1/2; DetA = 1.
    score = hota([[frame([0], [one], [[1.0]]) for one in (1, 1, 2, 2)]])
    assert score.det_a == 1.0 and score.ass_a == pytest.approx(0.5) and score.hota == pytest.approx(0.5**0.5)


def test_half_of_the_frames_missed_and_a_false_track() -> None:
    # TP 2, FN 2, FP 2. A = 2 / (2 + 2 + 0); HOTA = sqrt(2 * 0.5 / 6).
    frames = [frame([0], [0]), frame([0], [7]), frame([0], [0]), frame([0], [8])]
    score = hota([frames])
    assert score.det_a == pytest.approx(2 / 6) and score.ass_a == pytest.approx(0.5)
    assert score.hota == pytest.approx((1 / 6) ** 0.5)


def test_thresholds_above_the_similarity_find_nothing() -> None:
    # 0.5 reaches ten of the nineteen thresholds, 0.05 to 0.5.
    score = hota([[frame([0], [0], [[0.5]])] * 3])
    assert score.hota == pytest.approx(10 / 19)
    assert score.loc_a == pytest.approx((10 * 0.5 + 9 * 1.0) / 19)


def test_sequences_do_not_share_identities() -> None:
    one = [frame([0], [0])] * 2
    assert hota([one, [frame([0], [1])._replace(similarity=np.array([[1.0]]))] * 2]).hota == 1.0


def test_nothing_at_all_and_nothing_found() -> None:
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
    if sum(len(f.objects) + len(f.found) for f in frames):
        assert hota([frames]).hota == pytest.approx(np.mean(twin(frames)), abs=1e-9)
