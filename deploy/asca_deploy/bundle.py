"""A model bundle: the folder that `asca export` writes and the detector runs, and nothing else is needed.

    encoder.onnx    points of pillars -> pillar features
    backbone.onnx   pseudo-image, channels last -> head maps
    bundle.json     everything that must agree with the graphs, and where they come from

docs/BUNDLE.md describes the files for readers in other languages.
"""

import hashlib
import json
from dataclasses import dataclass
from importlib import resources
from pathlib import Path
from typing import Any, Literal

from asca_deploy.canvas import CanvasFormat
from asca_deploy.input_check import ExpectedInput
from asca_deploy.layout import difference, layout_of
from asca_pillars.errors import AscaError, BundleError
from asca_pillars.files import atomic_path
from asca_pillars.pillars.pillar_spec import PillarSpec
from asca_pillars.schema import Strict, parse, to_dict

SCHEMA_VERSION = 2
MANIFEST = "bundle.json"
ENCODER = "encoder.onnx"
BACKBONE = "backbone.onnx"

_EXPORT_AGAIN = "export the bundle again with `asca export`"


@dataclass(frozen=True)
class GraphFile(Strict):
    """One ONNX file of the bundle."""

    file: str
    """Name inside the bundle's folder."""
    sha256: str


@dataclass(frozen=True)
class Graphs(Strict):
    """The two networks; the scatter stands between them, in NumPy."""

    encoder: GraphFile
    backbone: GraphFile

    @classmethod
    def of(cls, folder: str | Path) -> "Graphs":
        """The files encoder.onnx and backbone.onnx as they lie in `folder`."""
        return cls(*(GraphFile(name, file_sha256(Path(folder) / name)) for name in (ENCODER, BACKBONE)))


@dataclass(frozen=True)
class Parity(Strict):
    """How far the exported float graphs are from the trained model, largest over the compared scans."""

    head_maps_max_abs_error: float
    box_max_error_m: float
    yaw_max_error_rad: float
    scans: int
    tolerance: float
    """What `head_maps_max_abs_error` had to stay under."""


@dataclass(frozen=True)
class LayerQuantization(Strict):
    """One layer of the backbone in the sensitivity sweep."""

    layer: str
    """Its name in the model, such as `neck.blocks.0.0`."""
    logit_rms_error: float
    """Of the class logits of the best anchors, if this layer alone stays in floating point."""
    kept_float: bool


@dataclass(frozen=True)
class Quantization(Strict):
    """How the 8-bit backbone was made, and how far it is from the float one on scans it was not calibrated on."""

    calibration_scans: int
    compared_scans: int
    layers: tuple[LayerQuantization, ...]
    logit_rms_error: float
    """Of the class logits of the best anchors, all 8-bit layers together."""
    boxes: int
    """Boxes that the float bundle reports on the compared scans."""
    boxes_matched: int
    """Those that the 8-bit bundle reports too: same class, BEV IoU of at least 0.5."""
    boxes_added: int
    """Boxes that the 8-bit bundle alone reports."""


@dataclass(frozen=True)
class Provenance(Strict):
    """Where the weights come from, enough to make them again."""

    command: str
    """The command that trained the weights."""
    created: str
    """Date of the export, ISO 8601."""
    git_revision: str | None
    trained_on: str
    """The training data, in words."""
    seed: int | None
    steps: int
    """Optimizer steps; 0 for random weights."""
    versions: dict[str, str]
    """Python, torch, onnx and the like at export."""
    machine: str


@dataclass(frozen=True)
class Bundle(Strict):
    """The contents of bundle.json."""

    name: str
    spec: PillarSpec
    cpa: str
    """Reading of the correlative point attention in the encoder; the runtime need not know, people do."""
    channels: int
    """C, features of one pillar."""
    precision: Literal["float32", "int8"]
    """What backbone.onnx computes in."""
    canvas: CanvasFormat
    backbone_gmac: float
    """Multiply-accumulates of backbone.onnx, 10^9."""
    graphs: Graphs
    parity: Parity | None
    """None only while the export is still proving it; of a quantized bundle, the float graphs it was made from."""
    quantization: Quantization | None
    """None in float32."""
    expected_input: ExpectedInput
    provenance: Provenance
    license: str
    schema_version: int = SCHEMA_VERSION


def default_bundle_path() -> Path:
    """Folder of the model that is used unless another is named: 8-bit, the faster one on every CPU."""
    return shipped_bundles()["asca_small_sim_int8"]


def shipped_bundles() -> dict[str, Path]:
    """Folders of the models that come with the package, by name."""
    folders = Path(str(resources.files("asca_deploy") / "bundles")).iterdir()
    return {folder.name: folder for folder in sorted(folders) if (folder / MANIFEST).is_file()}


def find_bundle(bundle: str | Path | None) -> Path:
    """The folder meant by a path, by the name of a bundle that ships, or by None.

    Raises:
        BundleError: there is neither.
    """
    if bundle is None:
        return default_bundle_path()
    if Path(bundle).exists():
        return Path(bundle)
    shipped = shipped_bundles()
    if str(bundle) not in shipped:
        raise BundleError(
            f"{bundle}: no such folder, and no bundle of that name ships, only {', '.join(shipped)};"
            " make one with `asca export`"
        )
    return shipped[str(bundle)]


def sample_scan_path() -> Path:
    """The simulated scan that comes with the package, KITTI .bin."""
    return Path(str(resources.files("asca_deploy") / "samples" / "street.bin"))


def load_bundle(folder: str | Path) -> Bundle:
    """Read and verify a bundle: schema version, every key, both graphs' SHA-256, the derived layout.

    Raises:
        BundleError: the bundle is missing, damaged, mixed up with another or made for another version;
            one line that names the file, the value and the remedy.
    """
    manifest = Path(folder) / MANIFEST
    data = _read_manifest(manifest)
    layout = data.pop("layout", None)
    try:
        bundle = parse(Bundle, data, str(manifest))
    except AscaError as error:
        # The grid and the classes check themselves and do not know the file they were read from.
        where = "" if str(manifest) in str(error) else f"{manifest}: "
        raise BundleError(f"{where}{error}; {_EXPORT_AGAIN}") from None
    for graph in (bundle.graphs.encoder, bundle.graphs.backbone):
        _verify_graph(Path(folder), graph)
    if differs := difference(layout, layout_of(bundle.spec)):
        raise BundleError(
            f"{manifest}: `layout.{differs}` is not what this version derives from `spec`; {_EXPORT_AGAIN}"
        )
    return bundle


def write_bundle_manifest(folder: str | Path, bundle: Bundle) -> None:
    """Write bundle.json beside the graphs in `folder`, which must lie there already."""
    for graph in (bundle.graphs.encoder, bundle.graphs.backbone):
        _verify_graph(Path(folder), graph)
    with atomic_path(Path(folder) / MANIFEST) as path:
        path.write_text(json.dumps(bundle_to_json(bundle), indent=1) + "\n", encoding="utf-8")


def bundle_to_json(bundle: Bundle) -> dict[str, Any]:
    """What bundle.json holds: the bundle's fields, and the `layout` that readers in other languages need."""
    return {"schema_version": bundle.schema_version, **to_dict(bundle), "layout": layout_of(bundle.spec)}


def file_sha256(path: str | Path) -> str:
    """SHA-256 of a file, hexadecimal."""
    with Path(path).open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def _read_manifest(manifest: Path) -> dict[str, Any]:
    try:
        data = json.loads(manifest.read_text(encoding="utf-8"))
    except (FileNotFoundError, NotADirectoryError):
        raise BundleError(
            f"{manifest.parent} is no model bundle, it holds no {MANIFEST}; make one with `asca export`"
        ) from None
    except OSError as error:
        raise BundleError(f"{manifest}: {error.strerror}") from None
    except (ValueError, RecursionError) as error:  # of the JSON, or of its UTF-8
        raise BundleError(f"{manifest} is damaged ({error}); {_EXPORT_AGAIN}") from None
    version = data.get("schema_version") if isinstance(data, dict) else None
    if type(version) is not int:
        raise BundleError(f"{manifest} is not a bundle's manifest: `schema_version` is {version!r}; {_EXPORT_AGAIN}")
    if version > SCHEMA_VERSION:
        raise BundleError(
            f"{manifest}: schema_version {version} is newer than {SCHEMA_VERSION}, which this version reads; "
            "upgrade with `pip install --upgrade asca-pillars`"
        )
    if version < SCHEMA_VERSION:
        raise BundleError(f"{manifest}: schema_version {version} is no longer read; {_EXPORT_AGAIN}")
    return dict(data)


def _verify_graph(folder: Path, graph: GraphFile) -> None:
    path = folder / graph.file
    if graph.file in ("", ".", "..") or any(mark in graph.file for mark in "/\\:"):
        raise BundleError(f"{folder / MANIFEST}: graph {graph.file!r} is not a file name; {_EXPORT_AGAIN}")
    if not path.is_file():
        raise BundleError(f"{path} is missing; copy the whole folder, or {_EXPORT_AGAIN}")
    found = file_sha256(path)
    if found != graph.sha256:
        raise BundleError(
            f"{path} is damaged or belongs to another bundle: its SHA-256 is {found[:12]}..., {MANIFEST} says"
            f" {graph.sha256[:12]}...; copy the whole folder again, or {_EXPORT_AGAIN}"
        )
