"""Mapping of OpenPCDet's arrays to ours; every array of either side must be matched."""

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from typing import NamedTuple

from torch import Tensor

from asca_pillars.base.errors import TrainingError

_NORM_PARTS = ("weight", "bias", "running_mean", "running_var")
_COUNTER = "num_batches_tracked"
_WITHOUT_EFFECT = ("global_step",)  # OpenPCDet's counter of training steps lies beside the weights
_NAMED = 5  # mismatched names in an error, at most


def identity(array: Tensor) -> Tensor:
    """Return unitless weights (out, in, ...), and arrays of any other shape, unchanged."""
    return array


def squeeze_kernel(array: Tensor) -> Tensor:
    """Reshape a 1x1 convolution's unitless weight (out, in, 1, ...) to a linear layer's (out, in)."""
    return array.flatten(1) if array.shape[2:].numel() == 1 else array


class KeyMapping(NamedTuple):
    """Mapping of one array: source name, target name, conversion."""

    source: str
    target: str
    convert: Callable[[Tensor], Tensor] = identity


def norm_keys(source: str, target: str) -> Iterator[KeyMapping]:
    """Return the key mappings of a normalization layer."""
    return (KeyMapping(f"{source}.{part}", f"{target}.{part}") for part in _NORM_PARTS)


def convert_state(
    state: Mapping[str, Tensor], key_mappings: Iterable[KeyMapping], our_state: Mapping[str, Tensor], path_text: str
) -> dict[str, Tensor]:
    """Convert their state dict to ours; every array of theirs is used, or named in the error.

    Args:
        state: theirs by name: unitless weights (out, in, ...) and the (C,) values of normalizations.
        key_mappings: what becomes what.
        our_state: our state dict, for names and shapes.
        path_text: the file, for messages.

    Raises:
        TrainingError: an array is missing, unknown, or of another shape than the configuration asks for.
    """
    key_mappings = list(key_mappings)
    known = {mapping.source for mapping in key_mappings}
    if missing := [name for name in known if name not in state]:
        raise TrainingError(f"{path_text}: lacks {_some(missing)}; the network of --config has other layers")
    if unknown := [name for name in state if name not in known and not _is_counter(name)]:
        raise TrainingError(
            f"{path_text}: {_some(unknown)}: no place for it in the network of --config; nothing is imported in part"
        )
    converted = {}
    for source, target, convert in key_mappings:
        found = convert(state[source])
        if found.shape != our_state[target].shape:
            raise TrainingError(
                f"{path_text}: {source} has shape {tuple(state[source].shape)}, which does not fit {target} "
                f"{tuple(our_state[target].shape)}; give the model's configuration with --config"
            )
        converted[target] = found.to(our_state[target].dtype).contiguous()
    counters = {name: value for name, value in our_state.items() if name.endswith(_COUNTER)}
    assert converted.keys() | counters.keys() == our_state.keys(), "a part of our network has no mapping"
    return counters | converted


def _is_counter(name: str) -> bool:
    return name in _WITHOUT_EFFECT or name.endswith(_COUNTER)


def _some(names: Iterable[str]) -> str:
    names = sorted(names)
    more = f" and {len(names) - _NAMED} more" if len(names) > _NAMED else ""
    return f"{', '.join(names[:_NAMED])}{more}"


_HEADS = {"scores": "conv_cls", "boxes": "conv_box", "directions": "conv_dir_cls"}


def map_backbone_keys(block_convs: Sequence[int], first: Callable[[Tensor], Tensor] = identity) -> Iterator[KeyMapping]:
    """Yield the key mappings of `backbone_2d` and `dense_head`.

    Args:
        block_convs: convolutions of each block after its first.
        first: conversion of the very first convolution's unitless weight (out, in, 3, 3), whose input channels may
            stand in another order.
    """
    for block, convs in enumerate(block_convs):
        there, here = f"backbone_2d.blocks.{block}", f"neck.blocks.{block}"
        for layer in range(0, 3 * (convs + 1), 3):  # convolution, normalization, ReLU; theirs begins with a padding
            convert = first if block == layer == 0 else identity
            yield KeyMapping(f"{there}.{layer + 1}.weight", f"{here}.{layer}.weight", convert)
            yield from norm_keys(f"{there}.{layer + 2}", f"{here}.{layer + 1}")
        there, here = f"backbone_2d.deblocks.{block}", f"neck.deblocks.{block}"
        yield KeyMapping(f"{there}.0.weight", f"{here}.0.weight")
        yield from norm_keys(f"{there}.1", f"{here}.1")
    for here, there in _HEADS.items():
        for part in ("weight", "bias"):
            yield KeyMapping(f"dense_head.{there}.{part}", f"head.{here}.{part}")


_LAYOUTS = (
    (4, 3, 0, 1, 2),  # kernel, inputs, outputs: 1.x
    (0, 4, 1, 2, 3),  # outputs, kernel, inputs: 2.x
    (3, 4, 0, 1, 2),  # kernel, outputs, inputs: 2.x, weights of its native algorithm
)
"""Position of the axes (out, in, z, y, x) of a dense convolution in each layout."""


def dense_order(pairs: Sequence[tuple[Tensor, Tensor]]) -> Callable[[Tensor], Tensor]:
    """Return the conversion of unitless sparse weights to (out, in, z, y, x), by the layout that fits all of them.

    Layers with as many inputs as outputs fit two of the layouts; all layers of a file have the same.

    Args:
        pairs: of each layer theirs, and ours.
    """
    for axes in _LAYOUTS:
        if all(theirs.ndim == len(axes) and theirs.permute(axes).shape == ours.shape for theirs, ours in pairs):
            return lambda weight: weight.permute(axes)
    return lambda weight: weight
