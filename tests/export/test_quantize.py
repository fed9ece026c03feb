"""Steps, rounding and the 8-bit graph, each against what it must not change."""

import copy

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from asca_deploy.bundle import CanvasFormat
from asca_deploy.pillar.pipeline import Canvas
from asca_export import quantize
from asca_export.fast_forms import STEP_VALUE, CanvasSteps, FastBackbone
from asca_export.quantize import WEIGHT_STEPS, canvas_steps, input_moments, layer_names, round_weights, scale_to_steps
from tests.export.tiny import tiny_detector

GRID = tiny_detector("none").grid


@pytest.fixture(scope="module")
def features() -> list[tuple[np.ndarray, np.ndarray]]:
    """Pillar features (P, C), some below zero as after attention, and cells, of a few scans."""
    rng = np.random.default_rng(0)
    scans = []
    for _ in range(4):
        cells = np.sort(rng.choice(GRID.ny * GRID.nx, 600, replace=False))
        scans.append((rng.gamma(0.5, 2.0, (600, 16)).astype(np.float32) - 0.5, cells))
    return scans


@pytest.fixture(scope="module")
def steps(features: list) -> CanvasSteps:
    return canvas_steps(each for each, _ in features)


@pytest.fixture(scope="module")
def canvases(features: list, steps: CanvasSteps) -> list[np.ndarray]:
    empty = tuple(int(step) for step in steps.empty)
    canvas = Canvas(16, GRID, CanvasFormat("uint8", empty))
    scale = steps.scale.numpy()
    return [
        canvas.scatter(np.clip(np.round(each / scale) + empty, 0, 255).astype(np.uint8), cells).copy()
        for each, cells in features
    ]


@pytest.fixture
def backbone(steps: CanvasSteps, canvases: list) -> FastBackbone:
    """Scaled to steps."""
    made = FastBackbone(tiny_detector("none"), steps).eval()
    scale_to_steps(made, canvases, steps)
    return made


@given(st.integers(0, 2**32 - 1))
@settings(max_examples=30, deadline=None)
def test_canvas_steps_hold_every_feature_and_zero_exactly(seed: int) -> None:
    rng = np.random.default_rng(seed)
    low, high = np.sort(rng.normal(0, 10, (2, 5)), axis=0)
    scans = [rng.uniform(low, high, (30, 5)).astype(np.float32) for _ in range(3)]
    steps = canvas_steps(scans)
    scale, empty = steps.scale.numpy(), steps.empty.numpy()
    assert ((empty == np.round(empty)) & (empty >= 0) & (empty <= 255)).all()
    counted = np.clip(np.round(np.concatenate(scans) / scale) + empty, 0, 255)
    # A step more at an end of the range where rounding the zero took one away.
    assert (np.abs(scale * (counted - empty) - np.concatenate(scans)) <= 1.001 * scale).all()


@torch.no_grad()
def test_counting_steps_changes_no_result(backbone: FastBackbone, steps: CanvasSteps, canvases: list) -> None:
    plain = FastBackbone(tiny_detector("none"), steps).eval()
    for canvas in canvases:
        image = torch.from_numpy(canvas) * STEP_VALUE
        for ours, theirs in zip(backbone(image), plain(image), strict=True):
            torch.testing.assert_close(ours, theirs, atol=1e-3, rtol=1e-3)


@torch.no_grad()
def test_activations_fill_the_steps_and_empty_space_is_whole(
    backbone: FastBackbone, steps: CanvasSteps, canvases: list
) -> None:
    highest = dict.fromkeys(layer_names(backbone), 0.0)
    for canvas in canvases:
        for name, activation in _outputs(backbone, torch.from_numpy(canvas)).items():
            highest[name] = max(highest[name], float(activation.max()))
    assert all(200 < high < 255 / 0.94 for name, high in highest.items() if name != "head"), highest
    canvas = steps.empty.expand(1, 257, 257, -1)
    for name, activation in _outputs(backbone, canvas).items():
        if name.startswith("blocks"):
            still = activation[0, :, activation.shape[2] // 2, activation.shape[3] // 2]
            large = still[still > 1]
            torch.testing.assert_close(large, large.round(), atol=2e-2, rtol=0)


@torch.no_grad()
def test_rounded_weights_lie_on_the_grid_and_empty_space_keeps_its_values(
    backbone: FastBackbone, steps: CanvasSteps, canvases: list
) -> None:
    moments = input_moments(backbone, canvases, steps)
    rounded = copy.deepcopy(backbone)
    round_weights(rounded, layer_names(backbone), moments)
    for name in layer_names(backbone):
        weight = rounded.get_parameter(f"{name}.weight")
        by_output = weight.T if name == "head" else weight.flatten(1)
        before = backbone.get_parameter(f"{name}.weight")
        before_by_output = before.T if name == "head" else before.flatten(1)
        units = by_output / before_by_output.abs().amax(dim=1, keepdim=True) * WEIGHT_STEPS
        torch.testing.assert_close(units, units.round(), atol=1e-3, rtol=0)
        # Were an output's largest weight smaller, the writer of the graph would round its weights to another grid.
        torch.testing.assert_close(units.abs().amax(dim=1), torch.full((len(units),), float(WEIGHT_STEPS)))
    canvas = steps.empty.expand(1, 257, 257, -1)
    exact, ours = _outputs(backbone, canvas), _outputs(rounded, canvas)
    for name in exact:
        middle = (0, slice(None), exact[name].shape[2] // 2, exact[name].shape[3] // 2)
        # What is left is the rounding of values below a step, which the next bias makes up for.
        assert (exact[name][middle] - ours[name][middle]).abs().max() < 1.0, name


@torch.no_grad()
def test_rounding_together_loses_less_than_rounding_alone() -> None:
    torch.manual_seed(0)
    inputs = torch.randn(2000, 4) @ torch.randn(4, 24) + 0.3 * torch.randn(2000, 24)  # strongly related
    weight = torch.randn(10, 24)
    squares = inputs.T @ inputs / len(inputs)
    unit = weight.abs().amax(dim=1, keepdim=True) / WEIGHT_STEPS
    alone = (weight / unit).round() * unit
    together = quantize.round_together(weight, squares)

    def error(rounded: torch.Tensor) -> float:
        return float(((rounded - weight) @ inputs.T).square().mean())

    assert error(together) < 0.5 * error(alone)
    assert (together - weight).abs().max() < 8 * float(unit.max())


def test_two_products_fit_16_bits() -> None:
    # What CPUs without VNNI add up before they widen it.
    largest = 2 * quantize.STEPS * WEIGHT_STEPS
    assert largest <= np.iinfo(np.int16).max


def _outputs(backbone: FastBackbone, counted: torch.Tensor) -> dict[str, torch.Tensor]:
    """Outputs of all layers but the head, in steps."""
    return {
        name: layer.output / STEP_VALUE
        for name, layer in quantize._passes(backbone, counted * STEP_VALUE)
        if name != "head"
    }
