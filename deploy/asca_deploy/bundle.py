"""Model bundle: the folder that `asca export` writes and `Detector` runs.

    *.onnx          the family's graphs
    bundle.json     settings that must agree with the graphs, and the origin of the weights
    weights.ckpt    optional: the trained weights, to resume training from; not read at run time

docs/BUNDLE.md describes the files for readers in other languages; `manifest` reads, verifies and writes bundle.json.
"""

import hashlib
import re
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

from asca_pillars.base.errors import ConfigError
from asca_pillars.base.own_files import json_object
from asca_pillars.base.strict import Strict
from asca_pillars.detection.spec import DetectorSpec
from asca_pillars.ops.pillar.neck_rulebooks import MaskRule
from asca_pillars.ops.pillar.spec import PillarSpec
from asca_pillars.ops.pv_rcnn.prepare import VoxelSetSettings
from asca_pillars.ops.pv_rcnn.spec import VoxelSpec
from asca_pillars.ops.two_stage.decode import Scores
from asca_pillars.ops.two_stage.first_stage import FirstStageSettings
from asca_pillars.ops.two_stage.prepare import RefineSettings
from asca_pillars.scans.input_check import ExpectedInput

SCHEMA_VERSION = 3
MANIFEST = "bundle.json"
BUNDLE_FOLDER = ("asca export", MANIFEST, json_object("schema_version", "graphs", "spec"))
"""Command, marker and its recognizer, as `atomic_directory` takes them."""
PFN = "pfn"
ENCODER = "encoder"
BACKBONE = "backbone"
REFINE = "refine"
PILLAR_GRAPHS = (ENCODER, BACKBONE)
VOXELS = "voxels"
DEFORM = "deform"
KEYPOINTS = "keypoints"
GRAPHS = {
    "pillar": PILLAR_GRAPHS,
    "pillar_refine": (*PILLAR_GRAPHS, REFINE),
    "pv_rcnn": (VOXELS, BACKBONE, KEYPOINTS, REFINE),
}
"""Names of the graphs of each kind; pillar detectors can have PFN before them."""
NECK = "neck"
"""Output of the backbone of a `pillar_refine` bundle: the head's input (1, H, W, C)."""

_LONGEST_NAME = 100
_MOST_CHANNELS = 4096


@dataclass(frozen=True)
class GraphFile(Strict):
    """One ONNX file of the bundle.

    Raises:
        ConfigError: the name may lead out of the folder, or the hash is none.
    """

    file: str
    """Name inside the bundle's folder."""
    sha256: str

    def __post_init__(self) -> None:
        name = self.file
        if name in ("", ".", "..") or len(name) > _LONGEST_NAME or not name.isprintable() or set(name) & set("/\\:"):
            raise ConfigError(f"graph {name[:_LONGEST_NAME]!r} is not a file name")
        _require_sha256(self.sha256, f"graph {name}")


@dataclass(frozen=True)
class CanvasFormat(Strict):
    """Format of the pseudo-image that backbone.onnx takes, and of the pillar features that encoder.onnx returns.

    Raises:
        ConfigError: a value that the type cannot hold.
    """

    type: Literal["float32", "uint8"] = "float32"
    """Type of one value; uint8 values are in steps of the quantized graph, which saves it the conversion."""
    empty: tuple[int, ...] = ()
    """Value of each channel (C,) where there is no pillar; () stands for zeros. A quantized channel has a zero of its
    own, because attention makes features negative."""

    def __post_init__(self) -> None:
        if wrong := [value for value in self.empty if not 0 <= value <= 255]:
            raise ConfigError(f"canvas.empty holds {str(wrong[0])[:20]}, which is not within 0..255")


@dataclass(frozen=True)
class PillarSection(Strict):
    """Section `pillar` of bundle.json: settings of the pillar encoder and of the neck.

    Raises:
        ConfigError: channels and canvas, or neck and active_cells, do not fit each other.
    """

    cpa: str
    """Variant of the correlative point attention in the encoder; informative, not read at run time."""
    channels: int
    """C, features of one pillar."""
    canvas: CanvasFormat
    neck: Literal["dense", "sparse"] = "dense"
    """`sparse`: backbone.onnx takes rows and rulebooks, and its outputs are rows of active head cells."""
    active_cells: MaskRule | None = None
    """Rule for the active cells of a sparse neck, see `asca_pillars.ops.pillar.neck_rulebooks`; None with a dense
    one."""

    def __post_init__(self) -> None:
        if not 1 <= self.channels <= _MOST_CHANNELS:
            raise ConfigError(f"channels {str(self.channels)[:20]} must lie between 1 and {_MOST_CHANNELS}")
        if (self.neck == "sparse") != (self.active_cells is not None):
            raise ConfigError(f"neck {self.neck} does not go with active_cells {self.active_cells}")
        allowed = (self.channels,) if self.canvas.type == "uint8" else (0, self.channels)
        if len(self.canvas.empty) not in allowed:
            raise ConfigError(
                f"canvas.empty holds {len(self.canvas.empty)} values where {self.channels} channels need one each"
            )


@dataclass(frozen=True)
class RefineSection(Strict):
    """Section `refine` of bundle.json: settings of the second stage of a pillar_refine bundle.

    Raises:
        ConfigError: no such number of channels.
    """

    bev_channels: int
    """C of the backbone's output `neck`."""
    seen: FirstStageSettings
    """Settings of proposals and keypoints."""
    neighbors: RefineSettings
    """Settings of balls and grids."""
    scores: Scores
    """Source of a refined box's score."""

    def __post_init__(self) -> None:
        if not 1 <= self.bev_channels <= _MOST_CHANNELS:
            raise ConfigError(f"bev_channels {str(self.bev_channels)[:20]} must lie between 1 and {_MOST_CHANNELS}")


@dataclass(frozen=True)
class Parity(Strict):
    """Largest differences between the exported float graphs and the trained model over the compared scans."""

    head_maps_max_abs_error: float
    """Largest absolute difference of the head maps. For `pillar_refine` it includes the neck's map and the second
    stage's confidences and residuals; for `pv_rcnn` the outputs of every graph, relative to their largest value where
    that is above 1."""
    box_max_error_m: float
    yaw_max_error_rad: float
    scans: int
    tolerance: float
    """Upper bound for `head_maps_max_abs_error`."""


@dataclass(frozen=True)
class LayerQuantization(Strict):
    """One layer of the backbone in the sensitivity sweep."""

    layer: str
    """Name of the layer in the model, such as `neck.blocks.0.0`."""
    logit_rms_error: float
    """RMS error of the class logits of the best anchors if this layer alone stays in floating point."""
    kept_float: bool


@dataclass(frozen=True)
class Quantization(Strict):
    """Calibration of the 8-bit backbone, and its differences from the float one on scans not calibrated on."""

    calibration_scans: int
    dropped_scans: int | None
    """Scans left out of the calibration because they are among the compared ones; None in older bundles."""
    compared_scans: int
    layers: tuple[LayerQuantization, ...]
    logit_rms_error: float
    """RMS error of the class logits of the best anchors, all 8-bit layers together."""
    boxes: int
    """Boxes that the float bundle reports on the compared scans."""
    boxes_matched: int
    """Boxes of the float bundle that the 8-bit bundle reports too: same class, BEV IoU of at least 0.5."""
    boxes_added: int
    """Boxes that the 8-bit bundle alone reports."""


@dataclass(frozen=True)
class Provenance(Strict):
    """Origin of the weights, with what is needed to train them again.

    Raises:
        ConfigError: the weights' hash is none.
    """

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
    weights_sha256: str | None = None
    """SHA-256 of the trained arrays, the same for every export of a checkpoint, see
    `asca_pillars.models.checkpoint_file`; None in bundles made before it was recorded."""
    weights_file: Literal["weights.ckpt"] | None = None
    """Checkpoint beside the graphs that holds the trained arrays in 16 bits; None if it was not exported."""
    weights_file_sha256: str | None = None
    """SHA-256 of `weights_file`; None in bundles made before it was recorded."""

    def __post_init__(self) -> None:
        _require_sha256(self.weights_file_sha256, "weights_file")
        _require_sha256(self.weights_sha256, "the weights")


@dataclass(frozen=True)
class PvRcnnSection(Strict):
    """Section `pv_rcnn` of bundle.json: channels and settings of PV-RCNN.

    Raises:
        ConfigError: no such number of channels.
    """

    voxel_channels: tuple[int, int, int, int, int]
    """Channels of conv1 to conv4 and of conv_out."""
    keypoint_channels: int
    """Channels of a keypoint's fused feature."""
    settings: VoxelSetSettings
    """Settings of keypoints, proposals and neighbors."""
    scores: Scores
    """Source of a refined box's score."""

    def __post_init__(self) -> None:
        for channels in (*self.voxel_channels, self.keypoint_channels):
            if not 1 <= channels <= _MOST_CHANNELS:
                raise ConfigError(f"channels {str(channels)[:20]} must lie between 1 and {_MOST_CHANNELS}")


@dataclass(frozen=True, kw_only=True)
class Bundle(Strict):
    """The fields of bundle.json that all kinds share."""

    name: str
    kind: str
    """Family of the detector, see GRAPHS."""
    spec: DetectorSpec
    precision: Literal["float32", "int8"]
    """Type of the arithmetic of backbone.onnx; for kind `pv_rcnn` of voxels.onnx too."""
    backbone_gmac: float
    """Multiply-accumulates of backbone.onnx, 10^9; with a sparse neck the mean over the scans of `parity`."""
    graphs: Mapping[str, GraphFile]
    """Graphs by name, see GRAPHS."""
    parity: Parity | None
    """Parity of the float graphs; None only until the export has measured it."""
    quantization: Quantization | None
    """None in float32."""
    expected_input: ExpectedInput
    expected_input_from: Literal["training", "export"]
    """Scans that `expected_input` was measured on: those of the training, or those given to the export."""
    provenance: Provenance
    license: str
    schema_version: int = SCHEMA_VERSION

    @property
    def graph_names(self) -> tuple[str, ...]:
        """Names of the graphs of this kind."""
        return GRAPHS[self.kind]


@dataclass(frozen=True, kw_only=True)
class PillarBundle(Bundle):
    """Bundle of a pillar detector, with or without a second stage. `pillar.layout` of the file follows from `spec`."""

    kind: Literal["pillar", "pillar_refine"]
    spec: PillarSpec
    pillar: PillarSection
    refine: RefineSection | None = None
    """None for kind pillar, whose bundle.json lacks the key."""

    @property
    def graph_names(self) -> tuple[str, ...]:
        """Names of the graphs, with PFN where the encoder is in two graphs."""
        return (PFN, *GRAPHS[self.kind]) if PFN in self.graphs else GRAPHS[self.kind]


@dataclass(frozen=True, kw_only=True)
class PvRcnnBundle(Bundle):
    """Bundle of PV-RCNN."""

    kind: Literal["pv_rcnn"]
    spec: VoxelSpec
    pv_rcnn: PvRcnnSection

    @property
    def graph_names(self) -> tuple[str, ...]:
        """Names of the graphs, with DEFORM where keypoints are shifted."""
        shifts = (DEFORM,) if self.pv_rcnn.settings.deformed else ()
        return (*GRAPHS[self.kind], *shifts)


def weights_digest(bundle: Bundle) -> str:
    """Return the SHA-256 of the trained arrays, the same in every export; if not recorded, one over the graphs'."""
    graphs = "".join(bundle.graphs[name].sha256 for name in sorted(bundle.graphs))
    return bundle.provenance.weights_sha256 or hashlib.sha256(graphs.encode()).hexdigest()


def _require_sha256(text: str | None, of: str) -> None:
    if text is not None and not re.fullmatch("[0-9a-f]{64}", text):
        raise ConfigError(f"sha256 {text[:_LONGEST_NAME]!r} of {of} is not a SHA-256")
