"""A checkpoint of OpenPCDet's PointPillars or PV-RCNN becomes one of ours."""

from pathlib import Path
from typing import NamedTuple

import torch
from torch import Tensor

from asca_pillars.config import Config
from asca_pillars.errors import ConfigError, TrainingError
from asca_pillars.files import atomic_path
from asca_pillars.input_files import require_content
from asca_pillars.models.build import build_model
from asca_pillars.models.checkpoint import unread
from asca_pillars.models.openpcdet.links import convert_state
from asca_pillars.models.openpcdet.pointpillars_links import pointpillars_links
from asca_pillars.models.openpcdet.pv_rcnn_links import FIRST_CONVOLUTION, pv_rcnn_links
from asca_pillars.pillar_config import PillarModel
from asca_pillars.pv_rcnn_config import PvRcnnModel
from asca_pillars.schema import to_dict

CONFIG_OF = {"vfe.pfn_layers.0.linear.weight": "openpcdet_pointpillars_kitti", FIRST_CONVOLUTION: "pv_rcnn_kitti"}
"""The configuration of the published model, by a name that only its family of checkpoints has."""


class ForeignWeights(NamedTuple):
    """What OpenPCDet wrote."""

    path: Path
    state: dict[str, Tensor]
    """Arrays by name."""
    steps: int
    """Optimizer steps behind them, as far as the file says."""


def read_foreign(path: str | Path) -> ForeignWeights:
    """Read a checkpoint of OpenPCDet, weights only: nothing in the file is executed.

    Raises:
        TrainingError: no such file, damaged, or something else.
    """
    path = Path(path)
    require_content(path, TrainingError)
    if not path.is_file():
        raise TrainingError(f"{path}: no such file; give a checkpoint of OpenPCDet (.pth)")
    try:
        content = torch.load(path, map_location="cpu", weights_only=True)
    except Exception as error:  # torch.load raises whatever the damaged bytes happen to trigger
        raise TrainingError(
            f"{path}: damaged, or holds more than weights, which is not read ({unread(error)})"
        ) from error
    state = content.get("model_state") if isinstance(content, dict) else None
    if not isinstance(state, dict) or not all(isinstance(value, Tensor) for value in state.values()):
        raise TrainingError(f"{path}: has no `model_state` with arrays, as OpenPCDet writes it")
    steps = content.get("it")
    return ForeignWeights(path, state, steps if isinstance(steps, int) and steps > 0 else 0)


def published_config(weights: ForeignWeights) -> str:
    """Name of the configuration that ships for this family of checkpoints.

    Raises:
        TrainingError: it is neither PointPillars nor PV-RCNN.
    """
    for name, config in CONFIG_OF.items():
        if name in weights.state:
            return config
    some = ", ".join(sorted({name.split(".")[0] for name in weights.state})[:8])
    raise TrainingError(f"{weights.path}: neither OpenPCDet's PointPillars nor its PV-RCNN; it has the parts {some}")


def write_imported(weights: ForeignWeights, config: Config, out: str | Path) -> int:
    """Write the weights as a checkpoint of `asca train`; how many arrays of theirs were used.

    Args:
        weights: theirs.
        config: of the same model.
        out: a file, such as pointpillars.ckpt.

    Raises:
        ConfigError: `config` is of another family, or has what theirs cannot have.
        TrainingError: an array is missing, unknown, or of another shape; nothing is imported in part.
    """
    model = config.model
    if isinstance(model, PillarModel):
        wanted, prefix = build_model(model).state_dict(), ""
        links = list(pointpillars_links(model, weights.state))
    elif isinstance(model, PvRcnnModel):
        prefix = "network."
        wanted = {name.removeprefix(prefix): value for name, value in build_model(model).state_dict().items()}
        links = list(pv_rcnn_links(model, weights.state, wanted))
    else:
        raise ConfigError(f"model.kind = {model.kind}: OpenPCDet has none; give pillar or pv_rcnn")
    linked = {link.target for link in links}
    if more := [name for name in wanted if name not in linked and not name.endswith("num_batches_tracked")]:
        raise ConfigError(f"--config: OpenPCDet's model has no {more[0]}; switch off what {config.name} adds to it")
    converted = convert_state(weights.state, links, wanted, str(weights.path))
    content = {
        "hyper_parameters": {"config": to_dict(config)},
        "global_step": weights.steps,
        "state_dict": {f"detector.{prefix}{name}": value for name, value in converted.items()},
    }
    with atomic_path(out) as temporary, temporary.open("wb") as file:  # see `AtomicCheckpointIO`
        torch.save(content, file)
    return len(weights.state)
