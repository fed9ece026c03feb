"""The order of training frames: shared by ranks, resumed by step, whole for validation."""

import pytest

from asca_pillars.base.errors import TrainingError
from asca_pillars.training.loaders import EpochSampler


def test_sampler_goes_on_where_the_steps_stopped() -> None:
    step = 0
    sampler = EpochSampler(11, 2, seed=0, step=lambda: step)
    epochs = []
    for _ in range(2):
        epochs.append(list(sampler))
        step += len(sampler)
    assert [len(epoch) for epoch in epochs] == [5, 5] and epochs[0] != epochs[1]
    step = 5 + 3
    assert list(sampler) == epochs[1][3:]
    assert {epoch for batch in epochs[1] for epoch, _ in batch} == {1}


def test_ranks_share_an_epoch() -> None:
    ranks = [EpochSampler(11, 2, 0, lambda: 0, rank=rank, world_size=2) for rank in range(2)]
    numbers = [{number for batch in sampler for _, number in batch} for sampler in ranks]
    assert [len(sampler) for sampler in ranks] == [2, 2]
    assert len(numbers[0]) == len(numbers[1]) == 4 and not numbers[0] & numbers[1]


def test_validation_sees_every_frame_once() -> None:
    assert [number for batch in EpochSampler(5, 2, 0, None) for _, number in batch] == [0, 1, 2, 3, 4]


def test_validation_gives_every_rank_as_many_batches() -> None:
    ranks = [EpochSampler(5, 2, 0, None, rank=rank, world_size=3) for rank in range(3)]
    seen = [[number for batch in sampler for _, number in batch] for sampler in ranks]
    assert seen == [[0, 3], [1, 4], [2, 0]] and [len(sampler) for sampler in ranks] == [1, 1, 1]


def test_too_few_frames_for_a_batch() -> None:
    with pytest.raises(TrainingError, match="3 training frames do not fill one batch of 4"):
        EpochSampler(3, 4, 0, lambda: 0)
