"""Reading, verifying and writing bundle.json.

A manifest that does not belong to its graphs would move boxes without any error. So everything that boxes depend on
is also in the metadata of each graph, under the graph's SHA-256, and the two have to agree.

Each graph is checked before a backend opens it, without the package `onnx`. The file is a protobuf message
(https://github.com/onnx/onnx/blob/main/onnx/onnx.proto); only the few fields below are read, others are skipped.
"""

import hashlib
import json
import reprlib
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from asca_deploy.bundle import (
    MANIFEST,
    PILLAR_GRAPHS,
    SCHEMA_VERSION,
    Bundle,
    GraphFile,
    PillarBundle,
    PvRcnnBundle,
)
from asca_pillars.base.errors import AscaError, BundleError, printable
from asca_pillars.base.files import require_content, write_json
from asca_pillars.base.installation import upgrade_advice
from asca_pillars.base.schema import parse, to_dict
from asca_pillars.detection.anchors import ANCHOR_YAWS_RAD
from asca_pillars.geometry.boxes import DIRECTION_OFFSET_RAD
from asca_pillars.ops.pillar.prepare import FEATURES
from asca_pillars.ops.pillar.spec import PillarSpec

EXPORT_AGAIN = "export the bundle again with `asca export`"
LONGEST_REASON = 300
"""Characters of a damaged file's own words in a message."""

_LARGEST_BYTES = 1 << 20


def read_manifest(manifest: Path) -> dict[str, Any]:
    """Read the keys and values of a bundle.json of a supported schema; BundleError if it is none."""
    try:
        require_content(manifest, BundleError)
        if manifest.stat().st_size > _LARGEST_BYTES:
            raise BundleError(f"{manifest} is larger than a manifest ever is (1 MiB); {EXPORT_AGAIN}")
        text = manifest.read_text(encoding="utf-8-sig")
        data = json.loads(text, object_pairs_hook=_without_duplicates, parse_constant=_no_number)
    except (FileNotFoundError, NotADirectoryError):
        refuse_run_folder(manifest.parent)
        raise BundleError(
            f"{manifest.parent} is not a model bundle, it holds no {MANIFEST}; make one with `asca export`"
        ) from None
    except OSError as error:
        raise BundleError(f"{manifest}: {error.strerror}") from None
    except RecursionError:
        raise BundleError(f"{manifest} is damaged (nested too deeply); {EXPORT_AGAIN}") from None
    except ValueError as error:  # invalid JSON or UTF-8
        raise BundleError(f"{manifest} is damaged ({printable(str(error), LONGEST_REASON)}); {EXPORT_AGAIN}") from None
    version = data.get("schema_version") if isinstance(data, dict) else None
    if type(version) is not int:
        version_text = reprlib.repr(version)
        raise BundleError(f"{manifest} is not a bundle's manifest: `schema_version` is {version_text}; {EXPORT_AGAIN}")
    if version > SCHEMA_VERSION:
        raise BundleError(
            f"{manifest}: schema_version {reprlib.repr(version)} is newer than {SCHEMA_VERSION}, which this version "
            f"reads; {upgrade_advice()}"
        )
    if version < SCHEMA_VERSION:
        raise BundleError(f"{manifest}: schema_version {reprlib.repr(version)} is no longer read; {EXPORT_AGAIN}")
    return dict(data)


def first_parsing_difference(written: Any, understood: Any) -> str | None:
    """Return the path of the first value that was not taken as it is written, such as true for 1 or a default; or None.

    A key that is understood as None need not be written: bundles made before there was such a key lack it.
    """
    if isinstance(understood, dict):
        if not isinstance(written, dict):
            return "*"
        for key, value in understood.items():
            if key not in written and value is None:
                continue
            if key not in written:
                return str(key)
            if inner := first_parsing_difference(written[key], value):
                return key if inner == "*" else f"{key}.{inner}"
        return None
    if isinstance(understood, list):
        if not isinstance(written, list) or len(written) != len(understood):
            return "*"
        for index, (written_value, understood_value) in enumerate(zip(written, understood, strict=True)):
            if inner := first_parsing_difference(written_value, understood_value):
                return str(index) if inner == "*" else f"{index}.{inner}"
        return None
    if isinstance(understood, float) and type(written) is int:
        return None if written == understood else "*"
    return None if type(written) is type(understood) and written == understood else "*"


def refuse_run_folder(folder: Path) -> None:
    """Raise BundleError, which names the checkpoint, if it is the folder of a training run."""
    last = folder / "checkpoints" / "last.ckpt"
    if last.is_file():
        raise BundleError(f"{folder} is the folder of a training run, no model bundle; give its checkpoint, {last}")


def _without_duplicates(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    members = dict(pairs)
    if len(members) < len(pairs):
        twice = next(key for number, (key, _) in enumerate(pairs) if key in dict(pairs[:number]))
        raise ValueError(f"key `{printable(twice, LONGEST_REASON)}` is there twice")
    return members


def _no_number(word: str) -> Any:
    raise ValueError(f"{word} is not a number")


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
    metadata = {}
    for number, value in _fields(memoryview(model)):
        if number == _MODEL_METADATA and isinstance(value, memoryview):
            entry = {key: bytes(text).decode() for key, text in _fields(value) if isinstance(text, memoryview)}
            metadata[entry.get(_ENTRY_KEY, "")] = entry.get(_ENTRY_VALUE, "")
    return metadata


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


ESSENTIALS = ("schema_version", "kind", "name", "license", "precision", "spec", "pillar")
"""Keys of bundle.json that are stamped into every graph's metadata, each as JSON."""

_ESSENTIALS_OF = {"pillar_refine": (*ESSENTIALS, "refine"), "pv_rcnn": (*ESSENTIALS[:-1], "pv_rcnn")}
# Defaults of keys that older bundles lack, in these sections and in a pillar detector's `spec` and `spec.grid`: bundles
# from before sparse necks, scores of both stages, other direction bins and anchors, and pooled maps. A removed key is
# detected by the graphs' metadata.
_LATER_KEYS: dict[str, dict[str, Any]] = {
    "spec": {"direction_offset_rad": DIRECTION_OFFSET_RAD},
    "pillar": {"neck": "dense"},
    "refine": {"scores": "second"},
    "pv_rcnn": {"scores": "second"},
}
_LATER_SPEC_KEYS = {"anchor_places": "cells", "anchor_scores": "own"}
_LATER_GRID_KEYS = {"map": "warped"}
_SAME_M = 1e-6


def load_pillar_bundle(folder: str | Path) -> PillarBundle:
    """Return a pillar detector's bundle, with or without a second stage, see `load_bundle`.

    Raises:
        BundleError: as `load_bundle`, or the bundle is of another kind.
    """
    bundle = load_bundle(folder)
    if not isinstance(bundle, PillarBundle):
        raise BundleError(
            f"{folder}: a bundle of kind {bundle.kind}, where one of a pillar detector is needed, such as default"
        )
    return bundle


def load_bundle(folder: str | Path) -> Bundle:
    """Read and verify a bundle: every key, the graphs' SHA-256, their stamped metadata, the derived layout.

    Raises:
        BundleError: the bundle is missing, damaged, mixed up with another or made for another version;
            one line that names the file, the value and the remedy.
    """
    folder = Path(folder)
    manifest = folder / MANIFEST
    data = read_manifest(manifest)
    stamped = {key: data.get(key) for key in _stamped_keys(data)}
    data |= {name: first | data[name] for name, first in _LATER_KEYS.items() if isinstance(data.get(name), dict)}
    family: type[Bundle] = PvRcnnBundle if data.get("kind") == "pv_rcnn" else PillarBundle
    layout = _pop_layout(manifest, data) if family is PillarBundle else None
    try:
        bundle = parse(family, data, str(manifest))
        if ignored := first_parsing_difference(data, to_dict(bundle)):
            raise BundleError(f"`{ignored}` is missing or of the wrong type")
    except AscaError as error:
        # The grid and the classes check themselves and do not know the file they were read from.
        raise BundleError(f"{_bundle_error_text(manifest, error)}; {EXPORT_AGAIN}") from None
    except (ArithmeticError, ValueError, RecursionError, MemoryError) as error:
        raise BundleError(
            f"{manifest}: a value makes no sense ({printable(str(error), LONGEST_REASON)}); {EXPORT_AGAIN}"
        ) from None
    if isinstance(bundle, PillarBundle):
        _verify_refine(manifest, bundle)
    if set(bundle.graphs) != set(bundle.graph_names):
        raise BundleError(
            f"{manifest}: a {bundle.kind} detector has the graphs {' and '.join(bundle.graph_names)}, not "
            f"{printable(', '.join(bundle.graphs), LONGEST_REASON) or 'none'}; {EXPORT_AGAIN}"
        )
    for graph in bundle.graphs.values():
        _verify_graph(folder, graph, stamped)
    if isinstance(bundle, PillarBundle) and (differs := difference(layout, layout_of(bundle.spec))):
        raise BundleError(
            f"{manifest}: `pillar.layout.{differs}` is not what this version derives from `spec`; {EXPORT_AGAIN}"
        )
    return bundle


def _pop_layout(manifest: Path, data: dict[str, Any]) -> Any:
    """Remove and return the layout of a pillar detector's manifest; later keys of `spec` get their first meaning."""
    if data.get("kind") == "pillar" and "refine" in data:
        raise BundleError(f"{manifest}: `refine` belongs to kind pillar_refine, this is pillar; {EXPORT_AGAIN}")
    layout = None
    if isinstance(section := data.get("pillar"), dict):
        layout = section.pop("layout", None)
    if isinstance(spec := data.get("spec"), dict) and isinstance(grid := spec.get("grid"), dict):
        data["spec"] = _LATER_SPEC_KEYS | spec | {"grid": _LATER_GRID_KEYS | grid}
    return layout


def write_bundle_manifest(folder: str | Path, bundle: Bundle) -> None:
    """Write bundle.json beside the graphs in `folder`, which must lie there already, stamped with `graph_metadata`."""
    stamped = graph_metadata(bundle)
    for graph in bundle.graphs.values():
        _verify_graph(Path(folder), graph, stamped)
    write_json(Path(folder) / MANIFEST, bundle_to_json(bundle))


def bundle_to_json(bundle: Bundle) -> dict[str, Any]:
    """Return the content of bundle.json: the bundle's fields, and the layout that other languages' readers need."""
    data = {"schema_version": bundle.schema_version, **to_dict(bundle)}
    if isinstance(bundle, PillarBundle):
        data["pillar"]["layout"] = layout_of(bundle.spec)
        if bundle.refine is None:
            del data["refine"]
    return data


def graph_metadata(bundle: Bundle) -> dict[str, Any]:
    """Return the fields that the export stamps into the metadata of each graph, see ESSENTIALS."""
    data = bundle_to_json(bundle)
    return {key: data[key] for key in _stamped_keys(data)}


def graph_files(folder: str | Path, names: Iterable[str] = PILLAR_GRAPHS) -> dict[str, GraphFile]:
    """Return the graphs of these names as they lie in `folder`, such as pfn.onnx, encoder.onnx and backbone.onnx."""
    files = {name: f"{name}.onnx" for name in names}
    return {name: GraphFile(file, _sha256((Path(folder) / file).read_bytes())) for name, file in files.items()}


def _stamped_keys(data: dict[str, Any]) -> tuple[str, ...]:
    return _ESSENTIALS_OF.get(str(data.get("kind")), ESSENTIALS)


def _verify_refine(manifest: Path, bundle: PillarBundle) -> None:
    if bundle.kind != "pillar_refine":
        return
    if bundle.refine is None:
        raise BundleError(f"{manifest}: `refine` is null, kind pillar_refine needs it; {EXPORT_AGAIN}")
    if len(bundle.refine.seen.proposals.quotas) != len(bundle.spec.classes):
        raise BundleError(f"{manifest}: `refine.seen.proposals.quotas` has not one for each class; {EXPORT_AGAIN}")


def _bundle_error_text(manifest: Path, error: AscaError) -> str:
    reason = str(error).removeprefix(f"{manifest}: ")
    return f"{manifest}: {printable(reason, LONGEST_REASON)}"


def _verify_graph(folder: Path, graph: GraphFile, stamped: dict[str, Any]) -> None:
    """Raise BundleError unless the file is there, whole, complete in itself, and stamped with these values."""
    path = folder / graph.file
    require_content(path, BundleError)
    if not path.is_file():
        raise BundleError(f"{path} is missing; copy the whole folder, or {EXPORT_AGAIN}")
    try:
        content = path.read_bytes()
    except OSError as error:
        raise BundleError(f"{path}: {error.strerror}; make it readable, or copy the whole folder again") from None
    digest = _sha256(content)
    if digest != graph.sha256:
        raise BundleError(
            f"{path} is damaged or belongs to another bundle: its SHA-256 is {digest[:12]}..., {MANIFEST} says"
            f" {graph.sha256[:12]}...; copy the whole folder again, or {EXPORT_AGAIN}"
        )
    try:
        metadata = read_metadata(content)
        if has_external_data(content):
            raise BundleError(f"{path} keeps weights in another file, which no SHA-256 covers; {EXPORT_AGAIN}")
        for key, value in stamped.items():
            if key not in metadata or _canonical(json.loads(metadata[key])) != _canonical(value):
                raise BundleError(
                    f"{folder / MANIFEST}: `{key}` is not the one that {graph.file} was exported with; "
                    f"copy the whole folder again, or {EXPORT_AGAIN}"
                )
    except (ValueError, RecursionError) as error:
        raise BundleError(f"{path} is damaged ({printable(str(error), LONGEST_REASON)}); {EXPORT_AGAIN}") from None


def _canonical(value: Any) -> str:
    return json.dumps(value, sort_keys=True)


def _sha256(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()


def layout_of(spec: PillarSpec) -> dict[str, Any]:
    """Return the part of bundle.json that follows from `spec`, written out for readers without our geometry code.

    The runtime derives these values itself; a bundle with other written values was edited by hand or made by a version
    with other features or anchors, and is refused.

    x_zones, y_zones: runs of equally sized pillars, ascending: first edge, size and number of pillars.
    canvas_shape: rows and columns of the pseudo-image, the first of each its padding.
    head_shape: (H, W) of the head maps.
    features: channels of the encoder's input. anchor_yaws_rad: the anchors of one class in one head cell.
    """
    return {
        "x_zones": _zones(spec.grid.x_edges_m),
        "y_zones": _zones(spec.grid.y_edges_m),
        "canvas_shape": [size + 1 for size in spec.grid.map_shape],
        "head_shape": list(spec.grid.head_shape),
        "features": list(FEATURES),
        "anchor_yaws_rad": list(ANCHOR_YAWS_RAD),
    }


def difference(written: Any, derived: Any) -> str | None:
    """Return the path of the first value that differs (metres and radians by more than 1e-6), or None."""
    if isinstance(derived, dict | list):
        keys = list(derived) if isinstance(derived, dict) else list(range(len(derived)))
        if not isinstance(written, type(derived)) or len(written) != len(derived):
            return "*"
        for key in keys:
            if isinstance(written, dict) and key not in written:
                return str(key)
            if inner := difference(written[key], derived[key]):
                return str(key) if inner == "*" else f"{key}.{inner}"
        return None
    if isinstance(derived, float) and isinstance(written, float):
        return None if abs(written - derived) <= _SAME_M else "*"
    return None if written == derived else "*"


def _zones(edges_m: NDArray[np.float64]) -> list[dict[str, Any]]:
    sizes_m = np.diff(edges_m)
    borders = np.flatnonzero(np.abs(np.diff(sizes_m)) > _SAME_M) + 1
    starts = [0, *borders.tolist()]
    ends = [*borders.tolist(), len(sizes_m)]
    return [
        {
            "start_m": round(float(edges_m[start]), 9),
            "pillar_m": round(float(edges_m[end] - edges_m[start]) / (end - start), 9),
            "pillars": end - start,
        }
        for start, end in zip(starts, ends, strict=True)
    ]
