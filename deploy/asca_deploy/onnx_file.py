"""Checks of an ONNX file before a backend opens it, read without the package `onnx`.

The file is a protobuf message (https://github.com/onnx/onnx/blob/main/onnx/onnx.proto); only the few fields below are
read, others are skipped.
"""

from collections.abc import Iterator
from typing import TypeAlias

_Message: TypeAlias = memoryview

_VARINT, _FIXED64, _BYTES, _FIXED32 = 0, 1, 2, 5  # protobuf's wire types
_FIXED_BYTES = {_FIXED64: 8, _FIXED32: 4}
_DEEPEST = 64  # graphs within graphs

# Field numbers of onnx.proto: which fields of a message lead to tensors, and to which kind of message.
_MODEL_METADATA = 14
_ENTRY_KEY, _ENTRY_VALUE = 1, 2
_TENSOR_EXTERNAL_DATA, _TENSOR_DATA_LOCATION = 13, 14
_WAYS_TO_TENSORS = {
    "model": {7: "graph", 25: "function"},
    "graph": {1: "node", 5: "tensor", 15: "sparse"},
    "function": {7: "node", 11: "attribute"},
    "node": {5: "attribute"},
    "attribute": {5: "tensor", 6: "graph", 10: "tensor", 11: "graph", 22: "sparse", 23: "sparse"},
    "sparse": {1: "tensor", 2: "tensor"},
}


def read_metadata(model: bytes) -> dict[str, str]:
    """Return the `metadata_props` of a model.

    Raises:
        ValueError: this is not an ONNX file.
    """
    found = {}
    for number, value in _fields(memoryview(model)):
        if number == _MODEL_METADATA and isinstance(value, memoryview):
            entry = {key: bytes(text).decode() for key, text in _fields(value) if isinstance(text, memoryview)}
            found[entry.get(_ENTRY_KEY, "")] = entry.get(_ENTRY_VALUE, "")
    return found


def has_external_data(model: bytes) -> bool:
    """Return whether any tensor of a model lies in another file.

    Raises:
        ValueError: this is not an ONNX file.
    """
    return _leads_outside(memoryview(model), "model", _DEEPEST)


def _leads_outside(message: _Message, kind: str, depth: int) -> bool:
    if not depth:
        raise ValueError("graphs are nested too deeply")
    if kind == "tensor":
        return any(
            number == _TENSOR_EXTERNAL_DATA or (number == _TENSOR_DATA_LOCATION and value == 1)
            for number, value in _fields(message)
        )
    ways = _WAYS_TO_TENSORS[kind]
    return any(
        isinstance(value, memoryview) and _leads_outside(value, ways[number], depth - 1)
        for number, value in _fields(message)
        if number in ways
    )


def _fields(message: _Message) -> Iterator[tuple[int, int | memoryview]]:
    """Yield number and value of each field: an int, or the bytes of a string, a packed list or a message."""
    place = 0
    while place < len(message):
        tag, place = _varint(message, place)
        number, wire = tag >> 3, tag & 7
        if wire == _VARINT:
            value, place = _varint(message, place)
            yield number, value
            continue
        if wire == _BYTES:
            size, place = _varint(message, place)
        elif wire in _FIXED_BYTES:
            size = _FIXED_BYTES[wire]
        else:
            raise ValueError(f"not an ONNX file: wire type {wire}")
        if size > len(message) - place:
            raise ValueError("not an ONNX file: it ends within a field")
        yield number, message[place : place + size]
        place += size


def _varint(message: _Message, place: int) -> tuple[int, int]:
    """Return the number that starts at `place`, and where it ends."""
    value = 0
    for shift in range(0, 70, 7):
        if place >= len(message):
            raise ValueError("not an ONNX file: it ends within a number")
        byte = message[place]
        place += 1
        value |= (byte & 0x7F) << shift
        if byte < 0x80:
            return value, place
    raise ValueError("not an ONNX file: a number has no end")
