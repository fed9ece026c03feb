"""How spconv lays out the weights of its convolutions, which differs between its versions."""

from collections.abc import Callable, Sequence

from torch import Tensor

_LAYOUTS = (
    (4, 3, 0, 1, 2),  # kernel, inputs, outputs: 1.x
    (0, 4, 1, 2, 3),  # outputs, kernel, inputs: 2.x
    (3, 4, 0, 1, 2),  # kernel, outputs, inputs: 2.x, weights of its native algorithm
)
"""Where each layout has the axes (out, in, z, y, x) of a dense convolution."""


def dense_order(pairs: Sequence[tuple[Tensor, Tensor]]) -> Callable[[Tensor], Tensor]:
    """The conversion of a network's unitless sparse weights to (out, in, z, y, x): the layout that fits all of them.

    Layers with as many inputs as outputs fit two of the layouts; all layers of a file have the same.

    Args:
        pairs: of each layer theirs, and ours.
    """
    for axes in _LAYOUTS:
        if all(theirs.ndim == len(axes) and theirs.permute(axes).shape == ours.shape for theirs, ours in pairs):
            return lambda weight: weight.permute(axes)
    return lambda weight: weight
