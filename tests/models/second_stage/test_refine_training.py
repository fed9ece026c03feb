"""Batches and the training loop of the second stage."""

import itertools

import numpy as np
import pytest
import torch

from asca_pillars.errors import TrainingError
from asca_pillars.models.second_stage.refine_sample import RefineSample, prepare_sample
from asca_pillars.models.second_stage.refine_training import one_cycle, sample_batches, train_refiner
from tests.models.refine.test_pillar_refiner import SETTINGS, proposed_frame, small_refiner


def prepare(number: int, rng: np.random.Generator) -> RefineSample:
    return prepare_sample(*proposed_frame(number), SETTINGS, 16, rng)


def test_batches_depend_on_the_seed_alone() -> None:
    first, again, other = (list(itertools.islice(sample_batches(prepare, 3, 2, seed), 3)) for seed in (0, 0, 1))
    for one, same in zip(first, again, strict=True):
        torch.testing.assert_close(one.inputs.roi_features, same.inputs.roi_features)
    assert any(
        one.inputs.points.shape != unlike.inputs.points.shape
        or not torch.equal(one.inputs.points, unlike.inputs.points)
        for one, unlike in zip(first, other, strict=True)
    )


def test_training_lowers_the_loss() -> None:
    network, losses = small_refiner(), []
    batches = itertools.cycle(itertools.islice(sample_batches(prepare, 2, 2, 0), 1))
    steps = train_refiner(
        network, batches, learning_rate=5e-3, steps=40, report=lambda _, terms: losses.append(terms.total.item())
    )
    assert steps == len(losses) == 40
    assert np.mean(losses[-5:]) < 0.7 * np.mean(losses[:5])
    assert not network.training


def test_training_by_the_clock_ends() -> None:
    assert train_refiner(small_refiner(), sample_batches(prepare, 2, 2, 0), learning_rate=1e-3, seconds=0.01) >= 1


def test_a_loss_that_is_not_finite_stops_the_run() -> None:
    network = small_refiner()
    last = network.head.confidence[-1]
    assert isinstance(last, torch.nn.Linear)
    torch.nn.init.constant_(last.bias, torch.nan)
    with pytest.raises(TrainingError, match="`confidence` is not finite at step 0"):
        train_refiner(network, sample_batches(prepare, 2, 2, 0), learning_rate=1e-3, steps=3)


def test_what_cannot_be_trained() -> None:
    with pytest.raises(TrainingError, match="steps or seconds"):
        train_refiner(small_refiner(), iter(()), learning_rate=1e-3)
    with pytest.raises(TrainingError, match="1 training frames"):
        next(sample_batches(prepare, 1, 2, 0))


def test_one_cycle() -> None:
    rates = [one_cycle(done) for done in np.linspace(0, 1, 101)]
    assert rates[0] == pytest.approx(0.1)
    assert max(rates) == rates[40] == pytest.approx(1)
    assert 0 < rates[-1] < 1e-3
