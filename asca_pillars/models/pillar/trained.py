"""A trained pillar detector that a setting names, a first stage or a teacher (distillation, arXiv 1503.02531)."""

import hashlib
import json
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import torch
from torch import Tensor

from asca_pillars.base.errors import BundleError, ConfigError
from asca_pillars.base.files import WEIGHTS_FILE, read_text, require_content
from asca_pillars.base.installation import find_shipped
from asca_pillars.base.schema import parse
from asca_pillars.config.pillar import PillarModel
from asca_pillars.config.tree import Config
from asca_pillars.detection.decode import PostProcess
from asca_pillars.models.checkpoint_file import read_checkpoint, weights_sha256
from asca_pillars.models.pillar.loss import distillation_loss
from asca_pillars.models.pillar.network import PillarDetector, PillarOutputs, build_pillar_detector
from asca_pillars.ops.pillar.spec import PillarSpec
from asca_pillars.ops.two_stage.first_stage import require_pillar_kind

_MANIFEST = "bundle.json"


class TrainedPillars(NamedTuple):
    """A trained pillar detector in evaluation mode, on the CPU.

    Attributes:
        network: with its weights.
        spec: of the bundle, or of the checkpoint's configuration.
        identity: digest of the trained weights; those of a bundle are rounded from them.
    """

    network: PillarDetector
    spec: PillarSpec
    identity: str


def load_trained_pillars(source: str, key: str, student: PillarSpec | None = None) -> TrainedPillars:
    """Load a trained pillar detector.

    Args:
        source: a checkpoint of `asca train`, or a bundle that holds one: its folder, or the name of one that ships.
        key: the setting that names it, for messages.
        student: the spec whose ranges the network gets; None for its own. Weights depend on no range, but zones do, and
            anchors that stand at its ends.

    Raises:
        TrainingError: not a checkpoint, damaged, or made by an incompatible version.
        BundleError: the bundle is missing, damaged, or holds no checkpoint.
        ConfigError: it is of another kind, or a bundle in 8 bits.
    """
    weights = _find_weights(source, key)
    checkpoint = read_checkpoint(weights.path)
    model = checkpoint.config.model
    require_pillar_kind(source, model.kind)
    assert isinstance(model, PillarModel), "it is of kind pillar"
    spec = model.spec if weights.spec is None else weights.spec
    if student is not None and spec.grid.zones == 1 and spec.anchor_places == "cells":
        grid = replace(spec.grid, x_range_m=student.grid.x_range_m, y_range_m=student.grid.y_range_m)
        spec = replace(spec, grid=grid, limits=replace(spec.limits, max_pillars=student.limits.max_pillars))
    network = build_pillar_detector(replace(model, spec=spec)).eval()
    checkpoint.fill(network)
    return TrainedPillars(network, spec, weights.identity or weights_sha256(network.state_dict()))


class _Weights(NamedTuple):
    """A checkpoint, with spec and identity of the bundle that holds it, if any."""

    path: Path
    spec: PillarSpec | None = None
    identity: str = ""
    """Identifier of the trained weights; the bundle's are rounded from them."""


def _find_weights(source: str, key: str) -> _Weights:
    path = Path(source)
    if path.suffix == Path(WEIGHTS_FILE).suffix or path.is_file():
        return _Weights(path)
    folder = path if path.exists() else find_shipped(source)
    if folder is None:
        raise BundleError(
            f"{source}: no such bundle or checkpoint; set {key} to the folder of one that was exported "
            "with --with-weights, or to RUN/checkpoints/last.ckpt"
        )
    weights, manifest = folder / WEIGHTS_FILE, folder / _MANIFEST
    if not manifest.is_file():
        return _Weights(weights)
    try:
        data = json.loads(read_text(manifest, BundleError))
        kind, precision, provenance = str(data["kind"]), data["precision"], data["provenance"]
        identity, digest = (str(provenance.get(name) or "") for name in ("weights_sha256", "weights_file_sha256"))
    except (OSError, ValueError, KeyError, TypeError, AttributeError):
        raise BundleError(f"{manifest}: cannot be read, or is damaged; copy the whole bundle again") from None
    require_pillar_kind(folder, kind)
    if precision != "float32":
        raise ConfigError(f"{folder}: a bundle in {precision}; give one in float32")
    require_content(weights, BundleError)
    if not weights.is_file():
        raise BundleError(
            f"{folder}: holds no {WEIGHTS_FILE}, from which its network is built; set {key} to its checkpoint, or "
            "export it again with --with-weights"
        )
    if digest and hashlib.sha256(weights.read_bytes()).hexdigest() != digest:
        raise BundleError(f"{weights}: is damaged, or of another bundle; copy the whole bundle again")
    return _Weights(weights, parse(PillarSpec, data["spec"], str(manifest)), identity)


class Distillation:
    """Terms of the loss that a teacher adds. No `nn.Module`, so that a checkpoint does not hold the teacher's weights.

    Args:
        config: of the detector that learns.
        teacher: a checkpoint of `asca train`, or a bundle that holds one: its folder, or the name of one that ships.

    Raises:
        ConfigError: `config` is of another kind, or the teacher has other pillars, anchors or active cells. Its ranges
            may differ where its pillars are uniform.
        AscaError: as `load_trained_pillars`.
    """

    def __init__(self, config: Config, teacher: str) -> None:
        model = config.model
        if not isinstance(model, PillarModel):
            raise ConfigError(f"train.teacher = {teacher}: only model.kind pillar supports a teacher; leave it out")
        self._network, spec, _ = load_trained_pillars(teacher, "train.teacher", student=model.spec)
        self._loss, self._weight = model.loss, config.train.teacher_weight
        student, teaching = model.network, self._network.preparation
        if _anchors(spec) != _anchors(model.spec):
            raise ConfigError(
                f"train.teacher = {teacher}: its model.spec differs; give both the same grid, limits and classes, or "
                "set train.teacher=null"
            )
        if teaching.active_cells != (student.active_cells if student.neck == "sparse" else None):
            raise ConfigError(
                f"train.teacher = {teacher}: its neck differs; give both the same model.network.neck and "
                "model.network.active_cells, or set train.teacher=null"
            )

    def __call__(self, outputs: PillarOutputs, batch: Any) -> Mapping[str, Tensor]:
        """Return the weighted terms by name, scalars, for the detector's outputs of a batch (`LabeledPillars`)."""
        network = self._network.to(batch.pillars.features.device)
        with torch.no_grad():
            teacher = network(batch.pillars)
        terms = distillation_loss(outputs.maps, teacher, self._loss)._asdict()
        return {name: self._weight * term for name, term in terms.items()}


def _anchors(spec: PillarSpec) -> PillarSpec:
    """Return the spec without what neither input nor anchors depend on."""
    classes = tuple(replace(kind, positive_iou=1.0, negative_iou=0.0, score_threshold=0.0) for kind in spec.classes)
    return replace(spec, post=PostProcess(), classes=classes)
