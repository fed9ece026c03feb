"""Intervals against resamples that are written out."""

import numpy as np
import pytest

from asca_pillars.evaluation.errors.error_summary import BLOCK_FRAMES, DRAWS, MIN_BLOCKS, bootstrap_samples

FRAMES = 60


def test_blocks_are_drawn_whole_and_parts_before_them() -> None:
    drawn = bootstrap_samples([np.arange(FRAMES)], FRAMES)
    assert drawn.weights.shape == (DRAWS, FRAMES)
    blocks = drawn.weights.reshape(DRAWS, FRAMES // BLOCK_FRAMES, BLOCK_FRAMES)
    assert (blocks == blocks[..., :1]).all()
    assert (blocks[..., 0].sum(axis=1) == FRAMES // BLOCK_FRAMES).all()
    np.testing.assert_allclose(drawn.weights.mean(axis=0), 1, atol=0.25)
    parts = [np.arange(0, 30), np.arange(30, 50)]
    drawn = bootstrap_samples(parts, FRAMES)
    assert not drawn.weights[:, 50:].any(), "frames of no part"
    first, second = (drawn.weights[:, part].sum(axis=1) for part in parts)
    assert set(zip(first.tolist(), second.tolist(), strict=True)) == {(60, 0), (30, 20), (0, 40)}


def test_median_and_ratio_are_those_of_the_resamples() -> None:
    rng = np.random.default_rng(1)
    frames, values = rng.integers(FRAMES, size=200), rng.normal(size=200)
    drawn = bootstrap_samples([np.arange(FRAMES)], FRAMES)
    heaps = [np.repeat(values, row[frames].astype(int)) for row in drawn.weights]
    medians = [np.sort(heap)[(len(heap) - 1) // 2] for heap in heaps]
    assert drawn.median_interval(values, frames) == pytest.approx(np.quantile(medians, [0.025, 0.975]))
    parts, wholes = rng.integers(0, 3, FRAMES).astype(float), np.full(FRAMES, 4.0)
    ratios = drawn.weights @ parts / (drawn.weights @ wholes)
    assert drawn.ratio_interval(parts, wholes) == pytest.approx(np.quantile(ratios, [0.025, 0.975]))


def test_like_frames_make_wide_intervals_and_few_blocks_none() -> None:
    rng = np.random.default_rng(2)
    drawn, frames = bootstrap_samples([np.arange(400)], 400), np.arange(400)
    alone, alike = rng.normal(size=400), np.repeat(rng.normal(size=40), 10)
    narrow, wide = (drawn.median_interval(values, frames) for values in (alone, alike))
    assert narrow is not None and wide is not None and wide[1] - wide[0] > 2 * (narrow[1] - narrow[0])
    drawn = bootstrap_samples([np.arange(FRAMES)], FRAMES)
    few = np.arange((MIN_BLOCKS - 1) * BLOCK_FRAMES)
    assert drawn.median_interval(few.astype(float), few) is None
    assert drawn.median_interval(np.zeros(0), np.zeros(0, int)) is None
    enough = np.arange(MIN_BLOCKS) * BLOCK_FRAMES
    assert drawn.median_interval(np.ones(MIN_BLOCKS), enough) == (1, 1)
    counts = np.zeros(FRAMES)
    assert drawn.ratio_interval(counts, counts) is None
