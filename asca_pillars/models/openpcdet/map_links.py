"""The parts that OpenPCDet's detectors on a map seen from above share: the 2D backbone and the anchors' head."""

from collections.abc import Callable, Iterator, Sequence

from torch import Tensor

from asca_pillars.models.openpcdet.links import Link, as_it_is, norm_links

_HEADS = {"scores": "conv_cls", "boxes": "conv_box", "directions": "conv_dir_cls"}


def map_links(block_convs: Sequence[int], first: Callable[[Tensor], Tensor] = as_it_is) -> Iterator[Link]:
    """Links of `backbone_2d` and `dense_head`.

    Args:
        block_convs: convolutions of each block after its first.
        first: conversion of the very first convolution's unitless weight (out, in, 3, 3), whose input channels may
            stand in another order.
    """
    for block, convs in enumerate(block_convs):
        there, here = f"backbone_2d.blocks.{block}", f"neck.blocks.{block}"
        for layer in range(0, 3 * (convs + 1), 3):  # convolution, normalization, ReLU; theirs begins with a padding
            convert = first if block == layer == 0 else as_it_is
            yield Link(f"{there}.{layer + 1}.weight", f"{here}.{layer}.weight", convert)
            yield from norm_links(f"{there}.{layer + 2}", f"{here}.{layer + 1}")
        there, here = f"backbone_2d.deblocks.{block}", f"neck.deblocks.{block}"
        yield Link(f"{there}.0.weight", f"{here}.0.weight")
        yield from norm_links(f"{there}.1", f"{here}.1")
    for here, there in _HEADS.items():
        for part in ("weight", "bias"):
            yield Link(f"dense_head.{there}.{part}", f"head.{here}.{part}")
