"""Which cells a convolution joins: kernel, stride and padding along z, y and x."""

import math
from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from asca_pillars.base.errors import ConfigError

Shape = tuple[int, int, int]
"""Cells along z, y, x; a map seen from above has one along z."""


class Links(NamedTuple):
    """What each tap joins a cell of one lattice with on another, axis by axis.

    Tap (kz, ky, kx) joins cell (z, y, x) with (links.z[z, kz], links.y[y, ky], links.x[x, kx]), or with nothing where
    one of them is -1.
    """

    z: NDArray[np.int64]
    """(nz, kernel along z), as the other two along theirs."""
    y: NDArray[np.int64]
    x: NDArray[np.int64]


@dataclass(frozen=True)
class Convolution:
    """A convolution's geometry; tap (kz, ky, kx) is number (kz * kernel_y + ky) * kernel_x + kx, as PyTorch stores it.

    Raises:
        ConfigError: a size that is not positive, or a padding as large as the kernel.
    """

    kernel: Shape
    stride: Shape
    padding: Shape

    def __post_init__(self) -> None:
        for kernel, stride, padding in zip(self.kernel, self.stride, self.padding, strict=True):
            if kernel < 1 or stride < 1 or not 0 <= padding < kernel:
                raise ConfigError(
                    f"a convolution with kernel {self.kernel}, stride {self.stride} and padding {self.padding}: kernel "
                    "and stride must be at least 1, the padding less than the kernel"
                )

    def output_shape(self, shape: Shape) -> Shape:
        """Cells of the output for an input of this shape."""
        sizes = zip(shape, self.kernel, self.stride, self.padding, strict=True)
        z, y, x = ((size + 2 * padding - kernel) // stride + 1 for size, kernel, stride, padding in sizes)
        return z, y, x

    @property
    def taps(self) -> int:
        """K, the kernel's cells."""
        return math.prod(self.kernel)

    def inputs(self, outputs: Shape, inputs: Shape) -> Links:
        """From an output to the inputs that it reads, on lattices of these shapes."""
        return _links(self, outputs, inputs, backward=False)

    def outputs(self, inputs: Shape, outputs: Shape) -> Links:
        """From an input to the outputs that read it."""
        return _links(self, inputs, outputs, backward=True)


def map_convolution(kernel: int, stride: int = 1, padding: int = 0) -> Convolution:
    """Of a map seen from above: nothing happens along z."""
    return Convolution((1, kernel, kernel), (1, stride, stride), (0, padding, padding))


@lru_cache(maxsize=256)  # the same few for every map
def _links(convolution: Convolution, shape: Shape, other: Shape, *, backward: bool) -> Links:
    axes = []
    for axis in range(3):
        taps, stride, padding = np.arange(convolution.kernel[axis]), convolution.stride[axis], convolution.padding[axis]
        places = np.arange(shape[axis])[:, None]
        joined, rest = np.divmod(places + padding - taps, stride) if backward else (places * stride - padding + taps, 0)
        exists = (rest == 0) & (joined >= 0) & (joined < other[axis])
        axes.append(np.where(exists, joined, -1))
        axes[-1].flags.writeable = False
    return Links(*axes)
