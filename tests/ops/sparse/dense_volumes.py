"""Active cells as dense volumes, and back."""

import numpy as np
import torch

from asca_pillars.ops.sparse.rulebooks import Shape


def random_cells(shape: Shape, share: float, seed: int) -> np.ndarray:
    return np.flatnonzero(np.random.default_rng(seed).random(int(np.prod(shape))) < share)


def dense(features: np.ndarray, cells: np.ndarray, shape: Shape) -> torch.Tensor:
    """(N, C) at cells -> (1, C, nz, ny, nx)."""
    z, y, x = shape
    volume = np.zeros((y * x * z, features.shape[1]))
    volume[cells] = features
    return torch.from_numpy(volume.reshape(y, x, z, -1).transpose(3, 2, 0, 1)[None].copy())


def at_cells(volume: torch.Tensor, cells: np.ndarray) -> np.ndarray:
    """The inverse of `dense`."""
    return volume[0].permute(2, 3, 1, 0).reshape(-1, volume.shape[1])[torch.from_numpy(cells)].numpy()
