"""Reading, verifying and writing bundle.json.

A manifest that does not belong to its graphs would move boxes without any error. So everything that boxes depend on
is also in the metadata of each graph, under the graph's SHA-256, and the two have to agree.
"""

import hashlib
import json
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from asca_deploy.bundle import (
    MANIFEST,
    PILLAR_GRAPHS,
    Bundle,
    GraphFile,
    PillarBundle,
    PvRcnnBundle,
)
from asca_deploy.manifest_file import EXPORT_AGAIN, LONGEST_REASON, first_parsing_difference, read_manifest
from asca_deploy.onnx_file import has_external_data, read_metadata
from asca_pillars.base.errors import AscaError, BundleError, printable
from asca_pillars.base.files import write_json
from asca_pillars.base.input_files import require_content
from asca_pillars.base.schema import parse, to_dict
from asca_pillars.detection.spec import ANCHOR_YAWS_RAD
from asca_pillars.geometry.boxes import DIRECTION_OFFSET_RAD
from asca_pillars.ops.pillar.prepare import FEATURES
from asca_pillars.ops.pillar.spec import PillarSpec

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
    """Return the graphs of these names as they lie in `folder`, such as encoder.onnx and backbone.onnx."""
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
    found = _sha256(content)
    if found != graph.sha256:
        raise BundleError(
            f"{path} is damaged or belongs to another bundle: its SHA-256 is {found[:12]}..., {MANIFEST} says"
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
