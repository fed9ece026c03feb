"""Graphs that torch.onnx made, kept for whichever test exports the same network again: an export takes seconds."""

import hashlib
import io
import pickle
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from types import SimpleNamespace
from typing import Any

import onnx
import pytest
import torch
from torch import Tensor, nn

from tests.helpers.made_once import made_once


@contextmanager
def exports_kept(factory: pytest.TempPathFactory) -> Iterator[None]:
    """While this lasts, torch.onnx exports each network once in this run of the tests."""
    export = torch.onnx.export

    def kept(module: nn.Module, example: Sequence[Tensor], **options: Any) -> Any:
        try:
            name = f"onnx_{digest(module, example, options)}"
        except (pickle.PicklingError, AttributeError, TypeError):  # made of what has no name, such as a lambda
            return export(module, tuple(example), **options)
        path = made_once(
            factory, name, lambda folder: onnx.save(_model(export(module, tuple(example), **options)), folder / "graph")
        )
        return SimpleNamespace(model_proto=onnx.load(path / "graph"))

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(torch.onnx, "export", kept)
        yield


def _model(program: Any) -> onnx.ModelProto:
    model: onnx.ModelProto = program.model_proto
    return model


def digest(module: nn.Module, example: Sequence[Tensor], options: Mapping[str, Any]) -> str:
    """Of all that an export depends on: code by its name, settings and weights by value, examples by their shape."""
    shapes = [(each.dtype, each.shape) for each in example]
    stream = io.BytesIO()
    _ByValue(stream).dump((module, shapes, options))
    return hashlib.sha256(stream.getvalue()).hexdigest()[:32]


class _ByValue(pickle.Pickler):
    """Tensors and names of dimensions by value; pickle would tell of where they lie in memory."""

    def persistent_id(self, item: Any) -> object:
        if isinstance(item, Tensor):
            values = item.detach().contiguous().numpy()
            return str(item.dtype), item.shape, item.requires_grad, hashlib.sha256(values.tobytes()).digest()
        if isinstance(item, torch.export.Dim):
            return "size", repr(item)
        if isinstance(item, torch._ops.OpOverload):
            return "operator", str(item)
        return None
