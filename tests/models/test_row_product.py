"""Products over padded rows equal those over rows as they are, and need few shapes."""

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch.nn import functional as F  # noqa: N812  (torch's own convention)

from asca_pillars.models.sparse_conv import linear_rows, pad_rows, rounded_rows


@given(st.integers(0, 1 << 22))
def test_rounds_up_by_a_sixteenth_at_most(rows: int) -> None:
    rounded = rounded_rows(rows)
    assert rows <= rounded <= rows + rows // 16
    assert rounded_rows(rounded) == rounded


def test_few_numbers_of_rows_remain() -> None:
    assert len({rounded_rows(rows) for rows in range(4096, 8192)}) <= 17


def test_padding_follows_the_rows() -> None:
    padded = pad_rows(torch.arange(101)[:, None], 7)
    assert padded[:, 0].tolist() == [*range(101), 7, 7, 7]


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
