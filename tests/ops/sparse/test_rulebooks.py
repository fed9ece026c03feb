"""Active cells and tables against dense convolution."""

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch.nn import functional as F  # noqa: N812  (torch's own convention)

from asca_pillars.base.errors import ConfigError
from asca_pillars.ops.pv_rcnn.rulebooks import PV_RCNN_STRIDED, SUBMANIFOLD
from asca_pillars.ops.sparse.rulebooks import CellMap, Convolution, Shape, map_convolution
from tests.ops.sparse.dense_volumes import at_cells, dense, random_cells

CONVOLUTIONS = (
    *PV_RCNN_STRIDED,
    SUBMANIFOLD,
    Convolution((3, 3, 3), (2, 2, 2), (0, 0, 0)),
    Convolution((2, 3, 1), (1, 3, 2), (1, 0, 0)),
    map_convolution(3, stride=2, padding=1),
    map_convolution(3, padding=1),
    map_convolution(2, stride=2),
    Convolution((1, 3, 3), (5, 1, 1), (0, 1, 1)),  # from a tall lattice to one that is one cell high
)
SHAPES = ((5, 8, 6), (1, 9, 4), (3, 3, 3), (63, 4, 3))

seeds, shares = st.integers(0, 2**32 - 1), st.sampled_from([0.0, 0.02, 0.3, 1.0])


@settings(max_examples=80, deadline=None)
@given(seeds, shares, shares, st.sampled_from(SHAPES), st.sampled_from(CONVOLUTIONS))
def test_a_convolution_by_table_is_the_dense_one(
    seed: int, share: float, earlier: float, shape: Shape, conv: Convolution
) -> None:
    if min(conv.output_shape(shape)) < 1:
        return
    source, target = CellMap(shape), CellMap(conv.output_shape(shape))
    for cells in (random_cells(shape, earlier, seed + 1), random_cells(shape, share, seed)):
        source.activate(cells)  # the second scan must not find anything of the first
        target.activate_joined([(source, conv.outputs(source.shape, target.shape))])
    rng = np.random.default_rng(seed)
    features, weight = rng.normal(size=(len(source), 3)), rng.normal(size=(4, 3, *conv.kernel))
    volume = dense(features, source.cells, shape)
    expected = F.conv3d(volume, torch.from_numpy(weight), stride=conv.stride, padding=conv.padding)

    seen = F.conv3d((volume != 0).any(1, keepdim=True).double(), torch.ones(1, 1, *conv.kernel).double(),
                    stride=conv.stride, padding=conv.padding)  # fmt: skip
    np.testing.assert_array_equal(target.cells, np.flatnonzero(seen[0, 0].permute(1, 2, 0).reshape(-1) > 0))

    rulebook = target.rulebook(source, conv.inputs(target.shape, source.shape))
    assert rulebook.shape == (len(target), conv.taps) and rulebook.dtype == np.int32
    gathered = np.vstack([features, np.zeros((1, 3))])[rulebook]  # (M, K, C)
    found = np.einsum("mkc,ock->mo", gathered, weight.reshape(4, 3, -1))
    np.testing.assert_allclose(found, at_cells(expected, target.cells), atol=1e-10)

    back = source.rulebook(target, conv.outputs(source.shape, target.shape))
    forward = {(row, tap, i) for (row, tap), i in np.ndenumerate(rulebook) if i < len(source)}
    assert forward == {(row, tap, i) for (i, tap), row in np.ndenumerate(back) if row < len(target)}


@settings(max_examples=60, deadline=None)
@given(seeds, shares, st.sampled_from([0, 1, 2]))
def test_places_of_an_upsampling(seed: int, share: float, halvings: int) -> None:
    stride, (ny, nx) = 1 << halvings, (8, 12)
    fine, coarse = (1, ny, nx), (1, ny // stride, nx // stride)
    children, parents = CellMap(fine), CellMap(coarse)
    children.activate(random_cells(fine, 0.6, seed))
    parents.activate(random_cells(coarse, share, seed + 1))
    values = np.full((ny // stride, nx // stride, stride, stride), len(parents) * stride**2)
    outputs = np.arange(len(parents) * stride**2).reshape(-1, stride, stride)
    values.reshape(-1, stride, stride)[parents.cells] = outputs
    expected = values.transpose(0, 2, 1, 3).reshape(-1)[children.cells]
    found = children.places(parents, halvings)
    assert found.dtype == np.int32
    np.testing.assert_array_equal(found, expected)


@pytest.mark.parametrize(
    ("shape", "message"), [((65, 4, 4), "64 along z"), ((64, 8000, 8000), "number"), ((1, 0, 4), "at least 1")]
)
def test_lattices_that_do_not_fit_are_refused(shape: Shape, message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        CellMap(shape)
