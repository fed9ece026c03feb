"""The whole network: Table 1's shapes and sizes, and that a feature cell lies where its anchor stands."""

import dataclasses
from typing import Any, Literal

import numpy as np
import pytest
import torch

from asca_pillars.config.pillar import CpaReading, NetworkConfig, PillarModel
from asca_pillars.data.frames import LabeledFrame
from asca_pillars.models.map_backbone import as_map
from asca_pillars.models.pillar.neck import RPNNeck
from asca_pillars.models.pillar.network import PillarDetector, build_pillar_detector
from asca_pillars.models.pillar.preparation import batch_pillars
from asca_pillars.ops.pillar.grid import PillarGrid, pool_pillars
from asca_pillars.ops.pillar.spec import PillarSpec
from tests.helpers.scenes import SPEC as SCENES
from tests.helpers.scenes import make_scene

# Rectangular, asymmetric, away from zero: a swapped axis or a forgotten minimum cannot hide.
SPEC = PillarSpec(grid=PillarGrid(x_range_m=(4.8, 20.16), y_range_m=(-7.68, 12.8), v_max_m=0.32, zones=3))


def _detector(cpa: CpaReading = "channel") -> PillarDetector:
    torch.manual_seed(0)
    return build_pillar_detector(PillarModel(spec=SPEC, network=NetworkConfig(cpa=cpa))).eval()


def _points(count: int = 600, seed: int = 0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    low, high = (4.8, -7.68, -2.0, 0.0), (20.16, 12.8, 0.5, 1.0)
    return rng.uniform(low, high, (count, 4)).astype(np.float32)


def test_neck_and_network_have_table_1s_widths_and_sizes() -> None:
    neck = RPNNeck(64, (64, 128, 256), (3, 3, 3), 128)
    assert neck(torch.zeros(1, 64, 16, 24)).shape == (1, 384, 8, 12)
    convolutions = 4 * 64 * 64 * 9 + (64 + 3 * 128) * 128 * 9 + (128 + 3 * 256) * 256 * 9
    upsampling = 64 * 128 + 128 * 128 * 4 + 256 * 128 * 16
    normalization = 2 * (4 * 64 + 4 * 128 + 4 * 256 + 3 * 128)

    def count(**network: Any) -> int:
        model = PillarModel(network=NetworkConfig(cpa="none", **network))
        return sum(p.numel() for p in build_pillar_detector(model).parameters())

    of_neck, head, pfn = convolutions + upsampling + normalization, 384 * (6 + 42 + 12) + 60, 9 * 64 + 128
    assert sum(p.numel() for p in neck.parameters()) == of_neck == 3_330_304
    assert count() == of_neck + head + pfn == 3_354_108
    # The original PointPillars has blocks of 3, 5 and 5 convolutions after the strided one: about 4.8 M parameters.
    original = count(block_convs=(3, 5, 5))
    assert original == 3_354_108 + 2 * (128 * 128 * 9 + 256) + 2 * (256 * 256 * 9 + 512)
    assert round(original / 1e6, 1) == 4.8


def test_scatter_equals_a_loop_and_frames_stay_apart() -> None:
    detector = _detector()
    ny, nx = SPEC.grid.ny, SPEC.grid.nx
    cells = torch.tensor([0, 5 * nx + 7, ny * nx - 1, 5 * nx + 7, 9])
    features = torch.rand(5, 64)
    canvas = detector.scatter(features, cells, [3, 2])
    expected = torch.zeros(2, 64, ny, nx)
    for pillar, (frame, cell) in enumerate(zip([0, 0, 0, 1, 1], cells.tolist(), strict=True)):
        expected[frame, :, cell // nx, cell % nx] = features[pillar]
    assert torch.equal(canvas, expected)


def test_an_empty_frame_in_a_batch_gives_maps() -> None:
    empty = SPEC.pillarize(np.empty((0, 4), np.float32))
    for cpa in ("none", "paper", "channel", "point", "linear"):
        maps = _detector(cpa)(batch_pillars([empty, SPEC.pillarize(_points())]))
        assert torch.isfinite(maps.scores).all() and len(maps.scores) == 2


@pytest.mark.parametrize("neck", ["dense", "sparse"])
@pytest.mark.parametrize("count", [0, 1, 50])
def test_scans_of_a_point_or_a_cell_are_learnt_from(neck: Literal["dense", "sparse"], count: int) -> None:
    """BatchNorm has no statistics of a single value; a training came to an end at such a scan."""
    torch.manual_seed(0)
    detector = build_pillar_detector(PillarModel(spec=SPEC, network=NetworkConfig(neck=neck))).train()
    points = np.full((count, 4), (10.05, 1.05, -1, 0.5), np.float32)
    points[:, 0] += np.linspace(0, 0.05, count)
    nothing = LabeledFrame("0", points, np.empty((0, 7), np.float32), np.empty(0, np.int64))
    batch = detector.preparation.collate([detector.preparation.prepare(nothing, None)])
    terms = detector.loss(detector.predict(batch), batch)
    total = torch.stack(list(terms.values())).sum()
    total.backward()
    assert torch.isfinite(total) and all(part.training for part in detector.modules())
    assert all(weight.grad is None or torch.isfinite(weight.grad).all() for weight in detector.parameters())
    if count:
        assert sum(float(weight.grad.abs().sum()) for weight in detector.parameters() if weight.grad is not None) > 0


@pytest.mark.parametrize(("row", "column"), [(3, 2), (30, 40), (60, 55), (31, 8)])
def test_a_pillar_excites_the_feature_cell_whose_anchor_stands_over_it(row: int, column: int) -> None:
    """The shortest path (Block1, DeBlock1) is traced: the strongest answer is at the anchor nearest to the pillar."""
    torch.manual_seed(0)
    neck = RPNNeck(1, (1, 1, 1), (0, 0, 0), 1).eval()
    with torch.no_grad():
        for name, parameter in neck.named_parameters():
            parameter.fill_(0.0 if name.endswith("bias") else 1.0)
        kernel = neck.get_parameter("blocks.0.0.weight")
        kernel.copy_(torch.tensor([[0.1, 0.2, 0.1], [0.2, 1.0, 1.0], [0.1, 1.0, 1.0]]))
    canvas = torch.zeros(1, 1, SPEC.grid.ny, SPEC.grid.nx)
    canvas[0, 0, 2 * row : 2 * row + 2, 2 * column : 2 * column + 2] = 1.0
    answer = neck(canvas)[0, 0]  # DeBlock1's channel
    found = np.unravel_index(int(answer.argmax()), answer.shape)
    assert found == (row, column)
    cells = np.array([2 * row * SPEC.grid.nx + 2 * column, (2 * row + 1) * SPEC.grid.nx + 2 * column + 1])
    pillar_center = SPEC.grid.cell_centers_m(cells).mean(axis=0)
    np.testing.assert_allclose(SPEC.anchors[row, column, 0, :2], pillar_center, atol=1e-4)


@pytest.mark.parametrize(("capability", "copied"), [("AVX2", True), ("AVX512", False), ("DEFAULT", False)])
def test_a_map_has_its_channels_first_and_is_copied_where_gradients_are_slow_otherwise(
    capability: str, copied: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(torch.backends.cpu, "get_cpu_capability", lambda: capability)
    cells = torch.arange(2 * 3 * 4 * 5.0).view(2, 3, 4, 5)
    found = as_map(cells)
    assert found.shape == (2, 5, 3, 4)
    assert torch.equal(found[1, :, 2, 3], cells[1, 2, 3])
    assert found.is_contiguous() == copied


POOLED = dataclasses.replace(SCENES, grid=dataclasses.replace(SCENES.grid, map="pooled"))
NETWORK = NetworkConfig(pillar_channels=8, block_channels=(8, 12, 16), block_convs=(1, 1, 1), upsample_channels=8)
EMPTY = np.empty((0, 4), np.float32)


def pooled_detector(neck: Literal["dense", "sparse"]) -> PillarDetector:
    torch.manual_seed(0)
    return build_pillar_detector(PillarModel(spec=POOLED, network=dataclasses.replace(NETWORK, neck=neck))).eval()


@pytest.mark.parametrize("neck", ["dense", "sparse"])
def test_frames_are_pooled_as_the_runtime_does_and_stay_apart(neck: Literal["dense", "sparse"]) -> None:
    detector = pooled_detector(neck)
    frames = [POOLED.pillarize(points) for points in (make_scene(0)[0], EMPTY, make_scene(1)[0])]
    placements = [detector.preparation.place(frame) for frame in frames]
    batch = batch_pillars(frames, placements)
    with torch.inference_mode():
        encoded = detector.encode(batch.features, batch.pillar_index, batch.point_counts, batch.frame_pillars)
        features, cells, frame_cells = detector.pool(encoded, batch)
    assert encoded.min() < 0 and sum(frame_cells) == len(cells) and frame_cells[1] == 0
    parts = encoded.split(list(batch.frame_pillars))
    for frame, own, found, where in zip(
        frames, parts, features.split(list(frame_cells)), cells.split(list(frame_cells)), strict=True
    ):
        pooled, occupied = pool_pillars(own.numpy(), frame.cells, POOLED.grid)
        np.testing.assert_array_equal(found.numpy(), pooled)
        np.testing.assert_array_equal(where.numpy(), occupied)
    with torch.inference_mode():
        together = detector(batch).scores
        alone = detector(batch_pillars(frames[2:], placements[2:])).scores
    torch.testing.assert_close(together[-len(alone) :], alone, rtol=0, atol=1e-5)


def test_gradients_reach_every_pillar_that_is_largest_somewhere() -> None:
    detector = pooled_detector("sparse").train()
    frame = POOLED.pillarize(make_scene(0)[0])
    batch = batch_pillars([frame], [detector.preparation.place(frame)])
    detector(batch).scores.square().sum().backward()
    gradient = detector.encode.linear.weight.grad
    assert gradient is not None and torch.isfinite(gradient).all() and gradient.abs().min() > 0
