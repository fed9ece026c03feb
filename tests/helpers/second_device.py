"""A GPU that is not there: tensors say that they are on it, so that tests find what a GPU would refuse.

Values stay in memory and the CPU computes them. What PyTorch refuses of two devices is refused as it would be: sums,
products and gathers across them, and NumPy arrays of what is not on the CPU. An index may come from the CPU, and so may
a scalar. Backward passes run outside of it, on plain tensors.
"""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import torch
from torch import Tensor, nn
from torch.overrides import TorchFunctionMode, resolve_name
from torch.utils._pytree import tree_leaves, tree_map_only

GPU = torch.device("cuda", 0)
_TAKE_BOTH = ("torch.Tensor.__getitem__", "torch.Tensor.__setitem__", "torch.Tensor.copy_")


class SecondDevice(TorchFunctionMode):
    """Within it `tensor.to("cuda")` gives a tensor of that GPU."""

    def __torch_function__(
        self,
        func: Callable[..., Any],
        types: Sequence[type],
        args: Sequence[Any] = (),
        kwargs: Mapping[str, Any] | None = None,
    ) -> Any:
        """One operation of PyTorch."""
        name, options = resolve_name(func) or func.__name__, dict(kwargs or {})
        match name:
            case "torch.Tensor.device.__get__" if on_gpu(args[0]):
                return GPU
            case "torch.Tensor.is_cuda.__get__":
                return on_gpu(args[0])
            case "torch.Tensor.to":
                return _moved(*args, **options)
            case "torch.Tensor.cpu":
                return _moved(args[0], "cpu")
            case "torch.Tensor.numpy" | "torch.Tensor.__array__" if on_gpu(args[0]):
                raise RuntimeError(f"{name}: the tensor is on the GPU")
        tensors = [one for one in tree_leaves((args, options)) if isinstance(one, Tensor)]
        here = [one for one in tensors if not on_gpu(one) and one.dim()]
        there = any(map(on_gpu, tensors))
        if there and here and name not in _TAKE_BOTH:
            raise RuntimeError(f"{name}: {len(here)} of {len(tensors)} tensors are on the CPU, the others are not")
        asked = options.pop("device", None)
        if asked is not None:
            there, options["device"] = torch.device(asked).type == GPU.type, "cpu"
        return tree_map_only(Tensor, lambda one: _put(one, there), func(*args, **options))


def on_gpu(tensor: Tensor) -> bool:
    """Whether the tensor says that it is there."""
    return getattr(tensor, "_on_gpu", False)


def move_weights(module: nn.Module) -> None:
    """`module.to("cuda")`, which moves weights in a way that is hidden from `SecondDevice`."""
    for one in (*module.parameters(), *module.buffers()):
        _put(one, there=True)


def _moved(tensor: Tensor, *where: Any, **options: Any) -> Tensor:
    """What `Tensor.to` gives: another type of numbers, another device, or both."""
    there = on_gpu(tensor)
    for one in (*where, *options.values()):
        if isinstance(one, torch.dtype):
            tensor = tensor.type(one)
        elif isinstance(one, Tensor):
            tensor, there = tensor.type(one.dtype), on_gpu(one)
        elif isinstance(one, str | torch.device):
            there = torch.device(one).type == GPU.type
    return _put(tensor if there == on_gpu(tensor) else tensor.clone(), there)


def _put(tensor: Tensor, there: bool) -> Tensor:
    tensor._on_gpu = there  # type: ignore[attr-defined]
    return tensor
