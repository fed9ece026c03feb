"""A backbone over voxels, level by level, against dense 3D convolution."""

import numpy as np
import pytest
import torch
from torch.nn import functional as F  # noqa: N812  (torch's own convention)

from asca_pillars.ops.pv_rcnn.rulebooks import PV_RCNN_STRIDED, SUBMANIFOLD, VoxelRulebookBuilder
from tests.ops.sparse.dense_volumes import at_cells, dense, random_cells

SHAPE = (41, 18, 12)


def by_rulebook(features: np.ndarray, rulebook: np.ndarray, weight: torch.Tensor) -> np.ndarray:
    gathered = np.vstack([features, np.zeros((1, features.shape[1]))])[rulebook]
    return np.einsum("mkc,ock->mo", gathered, weight.flatten(2).numpy())


@pytest.mark.parametrize("share", [0.0, 0.01, 0.2])
def test_every_level_is_the_dense_one(share: float) -> None:
    torch.manual_seed(0)
    builder = VoxelRulebookBuilder(SHAPE, training=True)
    for seed in range(2):
        builder.maps[0].activate(random_cells(SHAPE, share, seed))
        levels = builder.build()
        assert [cell_map.shape[0] for cell_map in builder.maps] == [41, 21, 11, 5, 2]
        features = np.random.default_rng(seed).normal(size=(len(levels[0].cells), 2))
        for number, (convolution, level) in enumerate(zip((None, *PV_RCNN_STRIDED), levels, strict=True)):
            if convolution is not None:
                weight = torch.randn(2, 2, *convolution.kernel, dtype=torch.float64)
                volume = dense(features, levels[number - 1].cells, builder.maps[number - 1].shape)
                volume = F.conv3d(volume, weight, stride=convolution.stride, padding=convolution.padding)
                features = by_rulebook(features, level.strided, weight)
                np.testing.assert_allclose(features, at_cells(volume, level.cells), atol=1e-9)
                assert float(volume.abs().sum()) == pytest.approx(np.abs(features).sum())  # nothing elsewhere
                assert len(level.strided_back) == len(levels[number - 1].cells)
            if number < len(levels) - 1:
                weight = torch.randn(2, 2, 3, 3, 3, dtype=torch.float64) / 5
                volume = F.conv3d(dense(features, level.cells, builder.maps[number].shape), weight, padding=1)
                features = by_rulebook(features, level.same, weight)
                np.testing.assert_allclose(features, at_cells(volume, level.cells), atol=1e-9)
        assert levels[-1].same.shape == (0, SUBMANIFOLD.taps)
