"""Shapes are what docstrings say: `(N, 7), (M, 7) -> (N, M)` is read from each, and held against calls of any sizes."""

import re
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from asca_pillars.geometry import boxes, overlap
from asca_pillars.models.map_backbone import SSDHead
from asca_pillars.models.pillar.encoder import (
    ChannelAttention,
    PaperAttention,
    PillarEncoder,
    PointAttention,
    pillar_max,
)
from asca_pillars.models.pillar.neck import RPNNeck
from asca_pillars.ops.pillar.grid import PillarGrid
from asca_pillars.ops.pillar.prepare import PillarLimits

LIMITS, GRID = PillarLimits(max_pillars=40, max_points=8), PillarGrid()
CHANNELS = 6


class Call(NamedTuple):
    """Arguments of a call; those whose shapes the docstring states come first, in its order."""

    arguments: Sequence[Any]
    stated: int


def random_boxes(rng: np.random.Generator, *shape: int) -> np.ndarray:
    return rng.uniform((0, -10, -2, 0.5, 0.5, 0.5, -3), (20, 10, 0, 5, 2, 2, 3), (*shape, 7))


def two_sets(rng: np.random.Generator, n: int, m: int) -> Call:
    return Call((random_boxes(rng, n), random_boxes(rng, m)), 2)


def pairs(rng: np.random.Generator, n: int, _: int) -> Call:
    return Call((random_boxes(rng, n), random_boxes(rng, n)), 2)


def one_set(rng: np.random.Generator, n: int, _: int) -> Call:
    return Call((random_boxes(rng, n),), 1)


def points_and_boxes(rng: np.random.Generator, n: int, m: int) -> Call:
    return Call((rng.uniform(-10, 10, (n, 4)).astype(np.float32), random_boxes(rng, m)), 2)


def anchored(rng: np.random.Generator, n: int, m: int) -> Call:
    return Call((rng.normal(0, 0.2, (n, m, 7)), rng.integers(0, 2, (n, m)), random_boxes(rng, n, m)), 3)


def any_shape(rng: np.random.Generator, n: int, m: int) -> Call:
    return Call((rng.uniform(-9, 9, (n, m)),), 1)


def cells(rng: np.random.Generator, n: int, _: int) -> Call:
    return Call((rng.integers(0, GRID.nx * GRID.ny, n),), 1)


def of_pillars(rng: np.random.Generator, n: int, m: int, channels: int) -> tuple[torch.Tensor, ...]:
    """Features of the points of m pillars that hold 1..n points each, the pillar of each point, and their numbers."""
    counts = torch.from_numpy(rng.integers(1, n + 2, m + 1))
    index = torch.arange(m + 1).repeat_interleave(counts)
    return torch.randn(len(index), channels), index, counts


def point_channels(rng: np.random.Generator, n: int, m: int) -> Call:
    return Call(of_pillars(rng, n, m, CHANNELS), 1)


def point_features(rng: np.random.Generator, n: int, m: int) -> Call:
    return Call(of_pillars(rng, n, m, 9), 1)


def features(_: np.random.Generator, n: int, __: int) -> Call:
    return Call((torch.randn(n + 1, CHANNELS),), 1)


def image(_: np.random.Generator, n: int, m: int) -> Call:
    return Call((torch.randn(2, CHANNELS, 8 * (n + 1), 8 * (m + 1)),), 1)


NECK, HEAD = RPNNeck(CHANNELS, (4, 8, 16), (1, 1, 1), 5).eval(), SSDHead(CHANNELS, 4).eval()
ENCODER = PillarEncoder(CHANNELS, "channel", LIMITS).eval()
CASES: tuple[tuple[Callable[..., Any], Callable[[np.random.Generator, int, int], Call]], ...] = (
    (boxes.footprints, one_set),
    (boxes.corners, one_set),
    (boxes.points_in_boxes, points_and_boxes),
    (boxes.encode_boxes, pairs),
    (boxes.decode_boxes, anchored),
    (boxes.direction_bins, any_shape),
    (overlap.bev_intersection, two_sets),
    (overlap.paired_bev_intersection, pairs),
    (overlap.paired_bev_touch, pairs),
    (overlap.bev_iou, two_sets),
    (overlap.iou_3d, two_sets),
    (overlap.aligned_bev_iou, two_sets),
    (GRID.cell_centers_m, cells),
    (pillar_max, point_channels),
    (ENCODER.forward, point_features),
    (PaperAttention(CHANNELS, 40).forward, features),
    (ChannelAttention(CHANNELS).forward, features),
    (PointAttention(CHANNELS, 8).forward, point_channels),
    (NECK.forward, image),
    (HEAD.forward, image),
    (HEAD.at_cells, features),
)


def stated_shapes(function: Callable[..., Any]) -> tuple[list[list[str]], list[list[str]]]:
    """The shapes left and right of the first arrow in the docstring, as lists of sizes."""
    left, _, right = " ".join((function.__doc__ or "").split()).partition(" -> ")
    sides = left, re.split(r"[.;](?:\s|$)", right)[0]  # to the end of the sentence
    inputs, outputs = (
        [re.split(r",\s*", shape.strip(",")) for shape in re.findall(r"\(([^()]*,[^()]*)\)", side)] for side in sides
    )
    return inputs, outputs


def fits(shape: Sequence[int], stated: Sequence[str], sizes: dict[str, int]) -> bool:
    """Whether a shape is the stated one; sizes that are named for the first time are what they are."""
    if stated[0] != "...":
        return fits_all(shape, stated, sizes)
    rank = len(shape) - len(stated) + 1
    leading = [("rank", rank), *((f"axis {axis}", size) for axis, size in enumerate(shape[: max(rank, 0)]))]
    same = all(sizes.setdefault(key, size) == size for key, size in leading)
    return rank >= 0 and same and fits_all(shape[rank:], stated[1:], sizes)


def fits_all(shape: Sequence[int], stated: Sequence[str], sizes: dict[str, int]) -> bool:
    return len(shape) == len(stated) and all(
        size_fits(size, text, sizes) for size, text in zip(shape, stated, strict=True)
    )


def size_fits(size: int, text: str, sizes: dict[str, int]) -> bool:
    if text.startswith(">="):
        return size >= int(text[2:])
    if text.isdecimal():
        return size == int(text)
    if text.isidentifier():
        return sizes.setdefault(text, size) == size
    factor, name, divisor = re.fullmatch(r"(\d*)([A-Z])(?: / (\d+))?", text).groups()  # type: ignore[union-attr]
    return size * int(divisor or 1) == sizes[name] * int(factor or 1)


@pytest.mark.parametrize(("function", "make"), CASES, ids=lambda case: getattr(case, "__qualname__", None))
@settings(max_examples=10)
@given(n=st.integers(0, 5), m=st.integers(0, 5), seed=st.integers(0, 2**32 - 1))
def test_shapes_are_those_of_the_docstring(
    function: Callable[..., Any], make: Callable[..., Call], n: int, m: int, seed: int
) -> None:
    call = make(np.random.default_rng(seed), n, m)
    inputs, outputs = stated_shapes(function)
    with torch.inference_mode():
        results = function(*call.arguments)
    results = results if isinstance(results, tuple) else (results,)
    given_shapes, sizes = [tuple(one.shape) for one in call.arguments[: call.stated]], dict[str, int]()
    if len(inputs) == 1 and call.stated == 2:  # "boxes and anchors (..., 7)"
        inputs = inputs * 2
    assert len(inputs) == len(given_shapes) and len(outputs) == len(results), (inputs, outputs)
    for shape, stated in zip((*given_shapes, *(tuple(one.shape) for one in results)), (*inputs, *outputs), strict=True):
        assert fits(shape, stated, sizes), f"{shape} is not {stated} with {sizes}"


def test_a_wrong_shape_is_noticed() -> None:
    assert not fits((3, 4), ["N", "M"], {"N": 4, "M": 3})
    assert not fits((3, 5, 2), ["...", "7"], {}) and fits((3, 5, 7), ["...", "7"], {})
    assert not fits((2, 13), ["B", "2A"], {"B": 2, "A": 6}) and fits((2, 12), ["B", "2A"], {"B": 2, "A": 6})
    assert not fits((2, 3), ["N", ">=4"], {})
