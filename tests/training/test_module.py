"""Rates, decay of weights, their average over the steps of a run, by hand; and the precision of its numbers."""

from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import lightning as L  # noqa: N812  (Lightning's own convention)
import numpy as np
import pytest
import torch
from torch import nn
from torch.optim import Optimizer

from asca_pillars.base.progress import Reporter
from asca_pillars.config.tree import Precision, TrainConfig, load_config
from asca_pillars.training import module as bfloat16
from asca_pillars.training.callbacks import weight_average
from asca_pillars.training.loop import train
from asca_pillars.training.module import (
    DetectionModule,
    cooldown_start,
    has_bfloat16,
    resolve_precision,
    warmup_stable_decay,
)
from tests.helpers.scenes import write_dataset
from tests.helpers.shipped_configs import CONFIGS
from tests.helpers.tiny_run import with_train

EPOCHS, RANKS, FRAMES = 5, 3, 29
STEPS = 4  # of an epoch: 29 frames are four whole batches of two on each of three ranks


def optimization(**changes: Any) -> tuple[Optimizer, Any]:
    """The optimizer and the schedule of a run that has begun."""
    module = DetectionModule(with_train(epochs=EPOCHS, batch_size=2, learning_rate=1e-3, **changes))
    datamodule = SimpleNamespace(training_set=range(FRAMES))
    module._trainer = SimpleNamespace(datamodule=datamodule, world_size=RANKS)  # type: ignore[assignment]
    module._fabric = None
    configured = module.configure_optimizers()
    assert configured["lr_scheduler"]["interval"] == "step"
    return configured["optimizer"], configured["lr_scheduler"]["scheduler"]


def rates(**changes: Any) -> list[float]:
    """The learning rate of each step of a run."""
    optimizer, schedule = optimization(**changes)
    used = []
    for _ in range(EPOCHS * STEPS):
        used.append(optimizer.param_groups[0]["lr"])
        optimizer.step()
        schedule.step()
    return used


def test_the_step_schedule_decays_every_so_many_epochs() -> None:
    expected = [1e-3 * 0.7 ** (step // (2 * STEPS)) for step in range(EPOCHS * STEPS)]
    np.testing.assert_allclose(rates(schedule="step", decay=0.7, decay_epochs=2), expected, rtol=1e-9)


def test_one_cycle_rises_for_three_tenths_of_the_run_and_ends_with_it() -> None:
    used = rates(schedule="one_cycle")
    peak, end = 6 - 1, 20 - 1  # the sixth and the last step
    low, lowest = 1e-3 / 10, 1e-3 / 10 / 1e4  # torch's own last value: the first one by 10000
    up = [low + (1e-3 - low) * (1 - np.cos(np.pi * step / peak)) / 2 for step in range(peak)]
    down = [
        lowest + (1e-3 - lowest) * (1 + np.cos(np.pi * (step - peak) / (end - peak))) / 2 for step in range(peak, 20)
    ]
    np.testing.assert_allclose(used, up + down, rtol=1e-6)


def test_a_stable_rate_rises_stays_and_falls_to_the_last_step() -> None:
    used = rates(schedule="warmup_stable_decay", warmup_steps=3, cooldown=0.25)  # 20 steps, the last five fall
    up = [0.25, 0.5, 0.75]
    down = [5 / 6, 4 / 6, 3 / 6, 2 / 6, 1 / 6]
    np.testing.assert_allclose(used, [1e-3 * factor for factor in [*up, *[1] * 12, *down]], rtol=1e-9)


def test_a_longer_stable_run_begins_as_the_shorter_one() -> None:
    recipe = TrainConfig(schedule="warmup_stable_decay", warmup_steps=3, cooldown=0.25)
    for total in (1, 7, 20, 33):
        until = cooldown_start(recipe, total)
        same = [warmup_stable_decay(recipe, total, step) for step in range(until)]
        assert same == [warmup_stable_decay(recipe, 100, step) for step in range(until)]
        assert all(warmup_stable_decay(recipe, total, step) > 0 for step in range(total))


def test_weights_decay_beside_the_gradient_and_not_through_it() -> None:
    """Through it, Adam would make a whole step of the rate out of any decay."""
    optimizer, _ = optimization(weight_decay=0.1)
    weights = [weight for group in optimizer.param_groups for weight in group["params"]]
    before = [weight.detach().clone() for weight in weights]
    for weight in weights:
        weight.grad = torch.zeros_like(weight)
    optimizer.step()
    for found, old in zip(weights, before, strict=True):
        torch.testing.assert_close(found.detach(), old * (1 - 1e-3 * 0.1), rtol=1e-6, atol=0)
    assert any(old.abs().max() > 0.1 for old in before)


class Normalized(L.LightningModule):
    """Weights, statistics and an integer count of batches."""

    def __init__(self) -> None:
        super().__init__()
        self.norm = nn.BatchNorm1d(3)


@pytest.mark.parametrize(("taken", "kept"), [(0, 0), (1, 2 / 11), (8, 9 / 18), (80, 81 / 90), (82, 0.9), (10**6, 0.9)])
def test_the_average_forgets_faster_at_first(taken: int, kept: float) -> None:
    """It starts as the weights are after the first step; what a normalization has counted is always the newest."""
    run, callback = Normalized(), weight_average(0.9)
    callback.setup(cast(L.Trainer, None), run, "fit")
    average = callback._average_model
    assert average is not None
    held = cast(Normalized, average.module).norm
    old, new = torch.tensor([1.0, -2.0, 4.0]), torch.tensor([3.0, 0.5, 4.0])
    for norm, values, count in ((held, old, 5), (run.norm, new, 7)):
        norm.load_state_dict(
            {"weight": values, "bias": -values, "running_mean": 2 * values, "running_var": values**2}
            | {"num_batches_tracked": torch.tensor(count)}
        )
    average.n_averaged.fill_(taken)
    callback.on_train_batch_end(cast(L.Trainer, SimpleNamespace(global_step=taken + 1)), run, None, None, 0)
    found = held.state_dict()
    np.testing.assert_allclose(found["weight"], kept * old + (1 - kept) * new, rtol=1e-6)
    np.testing.assert_allclose(found["bias"], -kept * old - (1 - kept) * new, rtol=1e-6)
    np.testing.assert_allclose(found["running_mean"], 2 * kept * old + 2 * (1 - kept) * new, rtol=1e-6)
    np.testing.assert_allclose(found["running_var"], kept * old**2 + (1 - kept) * new**2, rtol=1e-6)
    assert found["num_batches_tracked"] == 7


@pytest.mark.parametrize(
    ("precision", "with_it", "without"), [("auto", "bf16", "fp32"), ("bf16", "bf16", "bf16"), ("fp32", "fp32", "fp32")]
)
def test_auto_follows_the_device(
    precision: Precision, with_it: Precision, without: Precision, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(bfloat16, "has_bfloat16", lambda device: True)
    assert resolve_precision(precision) == with_it
    monkeypatch.setattr(bfloat16, "has_bfloat16", lambda device: False)
    assert resolve_precision(precision) == without


def test_a_gpu_answers_for_itself(monkeypatch: pytest.MonkeyPatch) -> None:
    of_the_cpu = has_bfloat16("cpu")
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    for native in (True, False):
        monkeypatch.setattr(torch.cuda, "is_bf16_supported", lambda including_emulation, native=native: native)
        assert has_bfloat16() is has_bfloat16("cuda") is native
        assert has_bfloat16("cpu") is of_the_cpu


@pytest.mark.skipif(not Path("/proc/cpuinfo").is_file(), reason="needs Linux to say what the CPU has")
def test_a_cpu_with_avx512_bf16_or_amx_has_it_and_one_without_avx512_has_not() -> None:
    flags = set(Path("/proc/cpuinfo").read_text().split())
    if flags & {"avx512_bf16", "amx_bf16"}:
        assert has_bfloat16()
    elif "avx2" in flags and not flags & {"avx512f", "avx_ne_convert"}:
        assert not has_bfloat16()


def test_a_run_goes_on_in_the_precision_it_was_started_in(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    data, run, path = write_dataset(tmp_path / "data", 3), tmp_path / "run", tmp_path / "run" / "config.yaml"
    for epochs, has_it, resolved in ((1, False, "fp32"), (2, True, "fp32"), (3, True, "bf16")):
        monkeypatch.setattr(bfloat16, "has_bfloat16", lambda device, has_it=has_it: has_it)
        if epochs == 3:  # an older version did not record it
            path.write_text(path.read_text().replace("precision: fp32", "precision: auto"))
        train(with_train(epochs=epochs, precision="auto"), data, run)
        assert load_config(path).train.precision == resolved
    monkeypatch.setattr("asca_pillars.training.loop.has_bfloat16", lambda: False)
    reporter = Reporter()
    train(with_train(epochs=4, precision="bf16"), data, run, reporter=reporter)
    assert any(text.startswith("train.precision = bf16: this device has no bfloat16") for text in reporter.remarks)


def test_configurations_that_ship_run_anywhere() -> None:
    assert len(CONFIGS) > 5
    for path in CONFIGS:
        assert load_config(path).train.precision in ("auto", "fp32"), f"{path}: slow where there is no bfloat16"
