"""The neck's active cells against pooled masks, and batches against single frames."""

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch.nn import functional as F  # noqa: N812  (torch's own convention)

from asca_pillars.ops.pillar.neck_rulebooks import MaskRule, NeckRulebookBuilder, stack_neck_rulebooks

NY, NX = 16, 24
RULES: tuple[MaskRule, ...] = ("sub", "fine")
BUILDERS = {rule: NeckRulebookBuilder(NY, NX, rule) for rule in RULES}
"""Each serves scan after scan."""


def cells(share: float, seed: int) -> np.ndarray:
    return np.flatnonzero(np.random.default_rng(seed).random(NY * NX) < share)


@settings(max_examples=40)
@given(st.integers(0, 2**32 - 1), st.sampled_from([0.0, 0.01, 0.2, 1.0]), st.sampled_from(RULES))
def test_active_cells_follow_the_rule(seed: int, share: float, rule: MaskRule) -> None:
    mask = torch.zeros(NY * NX)
    mask[torch.from_numpy(cells(share, seed))] = 1
    level, outputs = mask.view(1, 1, NY, NX), []
    rulebooks = BUILDERS[rule].build(cells(share, seed))
    for number, found in enumerate(rulebooks.levels):
        level = F.max_pool2d(level, 3, 2, 1)  # a strided output is active where it sees an active input
        outputs.append(F.max_pool2d(level, 3, 1, 1) if rule == "fine" and number == 0 else level)
        np.testing.assert_array_equal(found.strided_cells, level.flatten().nonzero()[:, 0])
        np.testing.assert_array_equal(found.cells, outputs[-1].flatten().nonzero()[:, 0])
    upsampled = [F.interpolate(output, (NY // 2, NX // 2)) for output in outputs]
    np.testing.assert_array_equal(rulebooks.head_cells, torch.stack(upsampled).amax(0).flatten().nonzero()[:, 0])
    for number, (found, seen) in enumerate(zip(rulebooks.levels, upsampled, strict=True)):
        missing = found.places == len(found.cells) * 4**number
        np.testing.assert_array_equal(~missing, seen.flatten()[torch.from_numpy(rulebooks.head_cells).long()] > 0)


def test_only_training_asks_for_inverse_tables() -> None:
    for training in (False, True):
        level = NeckRulebookBuilder(NY, NX, "fine", training=training).build(cells(0.1, 0)).levels[0]
        assert len(level.first_back) == len(level.strided_cells) * training
        assert len(level.strided_back) == len(cells(0.1, 0)) * training


@pytest.mark.parametrize("rule", RULES)
def test_a_batch_holds_its_frames(rule: MaskRule) -> None:
    builder = NeckRulebookBuilder(NY, NX, rule, training=True)
    pillars = [cells(share, seed) for seed, share in enumerate((0.1, 0.0, 0.3))]
    frames, counts = [builder.build(each) for each in pillars], [len(each) for each in pillars]
    batch = stack_neck_rulebooks(frames, counts)
    assert batch.frame_rows == tuple(len(frame.head_cells) for frame in frames)
    rows = np.cumsum([0, *batch.frame_rows])
    rng = np.random.default_rng(0)
    features = [rng.random((count, 2)) for count in counts]
    together = np.concatenate([*features, np.zeros((1, 2))])
    first = 0
    for number, (frame, own) in enumerate(zip(frames, features, strict=True)):
        np.testing.assert_array_equal(
            batch.head_cells[rows[number] : rows[number + 1]], frame.head_cells + number * (NY * NX // 4)
        )
        strided = frame.levels[0].strided
        read = np.concatenate([own, np.zeros((1, 2))])[strided]
        np.testing.assert_array_equal(together[batch.levels[0].strided[first : first + len(strided)]], read)
        first += len(strided)
    for level in batch.levels:
        forward = {(row, tap, i) for (row, tap), i in np.ndenumerate(level.first) if i < len(level.strided_cells)}
        inverse = {(row, tap, i) for (i, tap), row in np.ndenumerate(level.first_back) if row < len(level.cells)}
        assert forward == inverse
