"""The first stage that a configuration names, in PyTorch: a checkpoint, or the weights that a bundle holds."""

import hashlib
import json
from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from asca_pillars.base.errors import BundleError, ConfigError
from asca_pillars.base.files import WEIGHTS_FILE
from asca_pillars.base.input_files import read_text, require_content
from asca_pillars.base.installation import find_shipped
from asca_pillars.base.schema import parse
from asca_pillars.config.pillar import PillarModel
from asca_pillars.config.two_stage import RefineModel
from asca_pillars.detection.decode import HeadMaps, PostProcess
from asca_pillars.models.checkpoint_file import read_checkpoint, weights_sha256
from asca_pillars.models.pillar.network import build_pillar_detector
from asca_pillars.models.pillar.preparation import batch_pillars
from asca_pillars.ops.pillar.spec import PillarSpec
from asca_pillars.ops.two_stage.first_stage import FirstStage, FirstStageOutputs, require_pillar_kind

_MANIFEST = "bundle.json"


class TorchFirstStage:
    """A trained pillar detector in PyTorch, on the CPU; see `ops.two_stage.first_stage.FirstStage`.

    Args:
        source: a checkpoint of `asca train`, or a bundle that holds one: its folder, or the name of one that ships.

    Raises:
        TrainingError: not a checkpoint, damaged, or made by an incompatible version.
        BundleError: the bundle is missing, damaged, or holds no checkpoint.
        ConfigError: it is of another kind, or a bundle in 8 bits.
    """

    def __init__(self, source: str) -> None:
        self._source = source
        found = _find_weights(source)
        checkpoint = read_checkpoint(found.path)
        model = checkpoint.config.model
        require_pillar_kind(source, model.kind)
        assert isinstance(model, PillarModel), "it is of kind pillar"
        self.spec = model.spec if found.spec is None else found.spec
        self._network = build_pillar_detector(replace(model, spec=self.spec)).eval()
        checkpoint.fill(self._network)
        self.identity = found.identity or weights_sha256(self._network.state_dict())

    def __reduce__(self) -> tuple[Any, ...]:
        """Pickle as its source, from which the other process reads it."""
        return open_first_stage, (self._source,)

    def __call__(self, points: NDArray[np.float32]) -> FirstStageOutputs:
        """See `FirstStage`."""
        network, pillars = self._network, self.spec.pillarize(points)
        batch = batch_pillars([pillars], [network.preparation.place(pillars)])
        with torch.inference_mode():
            features = network.head_input(batch)
            maps = network.read_head(features, batch)
        if batch.neck is not None:
            rows = HeadMaps(*(part.numpy() for part in maps))
            return FirstStageOutputs(rows, features.numpy(), batch.neck.head_cells.int().numpy())
        channels_last = np.ascontiguousarray(features[0].permute(1, 2, 0).numpy())
        return FirstStageOutputs(HeadMaps(*(part[0].numpy() for part in maps)), channels_last)


def open_first_stage(source: str) -> FirstStage:
    """Return the first stage of that name, cached as long as its file stays the same, see `TorchFirstStage`.

    Raises:
        AscaError: as `TorchFirstStage`.
    """
    path = Path(source)  # for a bundle its folder, which an export replaces as a whole
    return _open_first_stage(source, path.stat().st_mtime_ns if path.exists() else 0)


@lru_cache(maxsize=2)
def _open_first_stage(source: str, _changed_ns: int) -> FirstStage:
    return TorchFirstStage(source)


def with_first_stage(model: RefineModel, stage: FirstStage | None = None) -> RefineModel:
    """Return the model with identity, spec and channels of its first stage.

    Args:
        model: of the second stage.
        stage: the first one, opened; None opens `model.first_stage`.

    Raises:
        AscaError: as `open_first_stage`.
        ConfigError: the model states other properties of it.
    """
    stage = stage or open_first_stage(model.first_stage)
    if model.first_stage_identity not in ("", stage.identity):
        raise ConfigError(
            f"model.first_stage = {model.first_stage}: other weights are there than those that the second stage was "
            "trained on; give it the same bundle or checkpoint, or train again"
        )
    spec = stage.spec
    assert isinstance(spec, PillarSpec), "all first stages are pillar detectors"
    if model.first_stage_identity == "" and model.spec != PillarSpec():
        raise ConfigError("model.spec is the first stage's where model.kind is pillar_refine: leave it out")
    if _geometry(model.spec) != _geometry(spec) and model.first_stage_identity:
        raise ConfigError(f"model.spec is not that of the first stage {model.first_stage}: train again")
    channels = stage(np.empty((0, 4), np.float32)).neck.shape[-1]
    if model.bev_channels not in (0, channels):
        raise ConfigError(
            f"model.bev_channels = {model.bev_channels}: the map of {model.first_stage} has {channels}; leave it out"
        )
    return replace(
        model,
        first_stage_identity=stage.identity,
        bev_channels=channels,
        spec=model.spec if model.first_stage_identity else spec,
    )


def _geometry(spec: PillarSpec) -> PillarSpec:
    """Return the spec without thresholds and suppression, which are those of the second stage."""
    return replace(spec.with_score_threshold(0.0), post=PostProcess())


class _Weights(NamedTuple):
    """Checkpoint of a first stage, with spec and identity of the bundle that holds it, if any."""

    path: Path
    spec: PillarSpec | None = None
    identity: str = ""
    """Identifier of the trained weights; the bundle's are rounded from them."""


def _find_weights(source: str) -> _Weights:
    path = Path(source)
    if path.suffix == Path(WEIGHTS_FILE).suffix or path.is_file():
        return _Weights(path)
    folder = path if path.exists() else find_shipped(source)
    if folder is None:
        raise BundleError(
            f"{source}: no such bundle or checkpoint; set model.first_stage to the folder of one that was exported "
            "with --with-weights, or to RUN/checkpoints/last.ckpt"
        )
    weights, manifest = folder / WEIGHTS_FILE, folder / _MANIFEST
    if not manifest.is_file():
        return _Weights(weights)
    try:
        data = json.loads(read_text(manifest, BundleError))
        kind, precision, provenance = str(data["kind"]), data["precision"], data["provenance"]
        identity, digest = (str(provenance.get(key) or "") for key in ("weights_sha256", "weights_file_sha256"))
    except (OSError, ValueError, KeyError, TypeError, AttributeError):
        raise BundleError(f"{manifest}: cannot be read, or is damaged; copy the whole bundle again") from None
    require_pillar_kind(folder, kind)
    if precision != "float32":
        raise ConfigError(f"{folder}: a bundle in {precision}; give one in float32")
    require_content(weights, BundleError)
    if not weights.is_file():
        raise BundleError(
            f"{folder}: holds no {WEIGHTS_FILE}, which a second stage is trained on; set model.first_stage to its "
            "checkpoint, or export it again with --with-weights"
        )
    if digest and hashlib.sha256(weights.read_bytes()).hexdigest() != digest:
        raise BundleError(f"{weights}: is damaged, or of another bundle; copy the whole bundle again")
    return _Weights(weights, parse(PillarSpec, data["spec"], str(manifest)), identity)
