"""Table convolutions against dense ones, and products over padded rows, forward and backward."""

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch.nn import functional as F  # noqa: N812  (torch's own convention)

from asca_pillars.models import map_backbone as module
from asca_pillars.models.map_backbone import linear_rows, rounded_rows, rulebook_conv
from asca_pillars.ops.pv_rcnn.rulebooks import PV_RCNN_STRIDED, SUBMANIFOLD
from asca_pillars.ops.sparse.rulebooks import CellMap, Convolution, Shape, map_convolution

CASES = (
    ((1, 8, 10), map_convolution(3, stride=2, padding=1)),
    ((1, 8, 10), map_convolution(3, padding=1)),
    ((7, 6, 8), SUBMANIFOLD),
    *(((7, 6, 8), convolution) for convolution in PV_RCNN_STRIDED),
)


def make_rulebooks(
    shape: Shape, convolution: Convolution, share: float
) -> tuple[CellMap, CellMap, tuple[torch.Tensor, torch.Tensor]]:
    """Input and output cells, and the two tables; cells of submanifold convolutions stay."""
    source, target = CellMap(shape), CellMap(convolution.output_shape(shape))
    source.activate(np.flatnonzero(np.random.default_rng(0).random(int(np.prod(shape))) < share))
    if target.shape == shape:
        target = source
    else:
        target.activate_joined([(source, convolution.outputs(source.shape, target.shape))])
    rulebook = target.rulebook(source, convolution.inputs(target.shape, source.shape))
    back = source.rulebook(target, convolution.outputs(source.shape, target.shape))
    return source, target, (torch.from_numpy(rulebook), torch.from_numpy(back))


@pytest.mark.parametrize(("shape", "convolution"), CASES)
@pytest.mark.parametrize(("chunk", "share"), [(64, 0.2), (1 << 20, 0.2), (64, 0.0)])
def test_equals_the_dense_convolution(
    shape: Shape, convolution: Convolution, chunk: int, share: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(module, "CHUNK_VALUES", chunk)
    torch.manual_seed(0)
    source, target, (rulebook, back) = make_rulebooks(shape, convolution, share)
    features = torch.randn(len(source), 3, dtype=torch.float64, requires_grad=True)
    weight = torch.randn(5, 3, *convolution.kernel, dtype=torch.float64, requires_grad=True)
    z, y, x = shape
    volume = features.new_zeros(y * x * z, 3).index_put((torch.from_numpy(source.cells),), features)
    volume = F.conv3d(
        volume.view(y, x, z, 3).permute(3, 2, 0, 1)[None], weight, None, convolution.stride, convolution.padding
    )
    expected = volume[0].permute(2, 3, 1, 0).reshape(-1, 5)[torch.from_numpy(target.cells)]
    found = rulebook_conv(features, weight, rulebook, None if target is source else back)
    torch.testing.assert_close(found, expected)
    upstream = torch.randn_like(expected)
    for one, other in zip(
        torch.autograd.grad(found, (features, weight), upstream),
        torch.autograd.grad(expected, (features, weight), upstream),
        strict=True,
    ):
        torch.testing.assert_close(one, other)


def test_autocast_computes_in_bfloat16_and_adds_up_in_float32() -> None:
    torch.manual_seed(0)
    source, _, (rulebook, back) = make_rulebooks((1, 40, 40), map_convolution(3, padding=1), share=0.5)
    features = torch.randn(len(source), 8, requires_grad=True)
    weight = torch.randn(8, 8, 1, 3, 3, requires_grad=True)
    expected = rulebook_conv(features, weight, rulebook, back)
    (exact,) = torch.autograd.grad(expected.square().sum(), weight)
    with torch.autocast("cpu", torch.bfloat16):
        found = rulebook_conv(features, weight, rulebook, back)
    assert found.dtype == torch.bfloat16
    torch.testing.assert_close(found.float(), expected, rtol=0.02, atol=0.2)
    (rounded,) = torch.autograd.grad(found.float().square().sum(), weight)
    assert rounded.dtype == torch.float32
    assert float((rounded - exact).norm() / exact.norm()) < 0.02


def test_the_same_bits_in_every_run() -> None:
    torch.manual_seed(0)
    source, _, (rulebook, back) = make_rulebooks((1, 64, 64), map_convolution(3, padding=1), share=0.4)
    features = torch.randn(len(source), 16, requires_grad=True)
    weight = torch.randn(16, 16, 1, 3, 3, requires_grad=True)
    threads = torch.get_num_threads()
    try:
        torch.set_num_threads(4)
        results = []
        for _ in range(8):
            found = rulebook_conv(features, weight, rulebook, back)
            results.append((found.detach(), *torch.autograd.grad(found.square().sum(), (features, weight))))
    finally:
        torch.set_num_threads(threads)
    for other in results[1:]:
        assert all(torch.equal(a, b) for a, b in zip(results[0], other, strict=True))


@given(st.integers(0, 1 << 22))
def test_rounds_up_by_a_sixteenth_at_most(rows: int) -> None:
    rounded = rounded_rows(rows)
    assert rows <= rounded <= rows + rows // 16
    assert rounded_rows(rounded) == rounded
    assert len({rounded_rows(rows) for rows in range(4096, 8192, 16)}) <= 17, "few numbers remain"


@pytest.mark.parametrize("rows", [0, 1, 33, 1001])
def test_a_product_in_lower_precision_is_that_of_the_rows(rows: int) -> None:
    features = torch.randn(rows, 12, generator=torch.Generator().manual_seed(0), requires_grad=True)
    weight, bias = torch.randn(8, 12, requires_grad=True), torch.randn(8, requires_grad=True)
    with torch.autocast("cpu", torch.bfloat16):
        found, expected = linear_rows(features, weight, bias), F.linear(features, weight, bias)
    assert found.dtype == torch.bfloat16
    torch.testing.assert_close(found, expected)
    upstream = torch.randn_like(expected)
    for one, other in zip(
        torch.autograd.grad(found, (features, weight, bias), upstream),
        torch.autograd.grad(expected, (features, weight, bias), upstream),
        strict=True,
    ):
        torch.testing.assert_close(one, other)
