"""Arrays and plain values of a checkpoint of another library, without that library and without its code."""

from pathlib import Path
from typing import Any

import torch

from asca_pillars.models.checkpoint_file import read_plain


class _Omitted:
    """Stands for an object whose class is not known here: it takes what a pickle gives it, and keeps none of it."""

    def __new__(cls, *_: Any, **__: Any) -> "_Omitted":
        return super().__new__(cls)

    def __init__(self, *_: Any, **__: Any) -> None:
        pass

    def __setstate__(self, _: Any) -> None:
        pass


def load_weights_alone(path: Path) -> dict[str, Any]:
    """The dictionary that a file of `torch.save` holds, weights only: nothing in it is executed.

    Training logs and settings beside the weights are often objects of NumPy or mmengine, which PyTorch refuses as it
    refuses code. Each name in the file that it does not know stands for `_Omitted`, so that the arrays can be read and
    no other class or function is ever called.

    Raises:
        Exception: as `read_plain`.
    """
    try:
        unknown = torch.serialization.get_unsafe_globals_in_checkpoint(path)
    except ValueError:  # a format from before PyTorch 1.6, in which names cannot be listed
        unknown = []
    with torch.serialization.safe_globals([(_Omitted, name) for name in unknown]):
        return read_plain(path)
