"""Import of checkpoints of OpenPCDet's or mmdetection3d's PointPillars or PV-RCNN."""

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal, NamedTuple

import torch
from torch import Tensor

from asca_pillars.base.errors import ConfigError, TrainingError
from asca_pillars.base.files import require_content
from asca_pillars.base.schema import to_dict
from asca_pillars.config.pillar import PillarModel
from asca_pillars.config.pv_rcnn import PvRcnnModel
from asca_pillars.config.tree import Config
from asca_pillars.models.build import build_model
from asca_pillars.models.checkpoint_file import read_failure, read_plain, write_plain
from asca_pillars.models.openpcdet.network_keys import (
    FIRST_CONVOLUTION,
    FIRST_LINEAR,
    FUSION,
    KeyMapping,
    convert_state,
    mmdetection3d_keys,
    pointpillars_keys,
    pv_rcnn_keys,
)

CONFIG_OF = {
    "vfe.pfn_layers.0.linear.weight": "openpcdet_pointpillars_kitti",
    FIRST_CONVOLUTION: "pv_rcnn_kitti",
    FIRST_LINEAR: "mmdetection3d_pointpillars_kitti",
    FUSION: "mmdetection3d_pv_rcnn_kitti",
}
"""Configuration of the published model, by a key that only its family of checkpoints has."""

_STATES: dict[str, Literal["OpenPCDet", "mmdetection3d"]] = {"model_state": "OpenPCDet", "state_dict": "mmdetection3d"}
_NOT_LEGACY = re.compile(r"\blegacy['\"]?\s*[=:]\s*False\b")  # in a configuration as Python or as JSON writes it


class ForeignWeights(NamedTuple):
    """Weights in a file of OpenPCDet or mmdetection3d."""

    path: Path
    state: dict[str, Tensor]
    """Arrays by name."""
    steps: int
    """Optimizer steps of the training, if the file has them."""
    library: Literal["OpenPCDet", "mmdetection3d"] = "OpenPCDet"
    classes: tuple[str, ...] = ()
    """Names of the classes in their order, if the file has them."""
    legacy: bool = True
    """Flag of mmdetection3d's encoder, see `encoder_keys`; true unless the configuration in the file denies it."""


def read_foreign(path: str | Path) -> ForeignWeights:
    """Read a checkpoint of OpenPCDet or mmdetection3d, weights only: nothing in the file is executed.

    Raises:
        TrainingError: no such file, damaged, or something else.
    """
    path = Path(path)
    require_content(path, TrainingError)
    if not path.is_file():
        raise TrainingError(f"{path}: no such file; give a checkpoint of OpenPCDet or mmdetection3d (.pth)")
    try:
        content = load_weights_alone(path)
    except Exception as error:  # torch.load raises whatever the damaged bytes happen to trigger
        raise TrainingError(
            f"{path}: damaged, or holds more than weights, which is not read ({read_failure(error)}); "
            "where the library that wrote it is installed, write a file with `model_state` (OpenPCDet) or `state_dict` "
            "(mmdetection3d) alone"
        ) from error
    if "hyper_parameters" in content:
        raise TrainingError(f"{path}: a checkpoint of `asca train`, which needs no import; give it to `asca export`")
    for key, library in _STATES.items():
        state = content.get(key)
        if isinstance(state, dict) and state and all(isinstance(value, Tensor) for value in state.values()):
            return _described(ForeignWeights(path, state, 0, library), content)
    raise TrainingError(
        f"{path}: has neither `model_state` with arrays, as OpenPCDet writes it, nor `state_dict`, as mmdetection3d "
        "does"
    )


def _described(weights: ForeignWeights, content: Mapping[str, Any]) -> ForeignWeights:
    """Return the weights with the metadata of the file.

    Raises:
        TrainingError: mmdetection3d before 1.0 wrote them.
    """
    meta = content.get("meta")
    meta = meta if isinstance(meta, dict) else {}
    if str(meta.get("mmdet3d_version", "")).startswith("0."):
        raise TrainingError(
            f"{weights.path}: trained by mmdetection3d {meta['mmdet3d_version']}, whose boxes have other axes than "
            "those of 1.0; give a checkpoint of 1.0 or later"
        )
    steps = content.get("it", meta.get("iter"))
    described = meta.get("dataset_meta")
    described = described if isinstance(described, dict) else {}
    classes: Any = described.get("classes", described.get("CLASSES", meta.get("CLASSES", ())))
    named = isinstance(classes, list | tuple) and all(isinstance(name, str) for name in classes)
    return weights._replace(
        steps=steps if isinstance(steps, int) and steps > 0 else 0,
        classes=tuple(classes) if named else (),
        legacy=not any(_NOT_LEGACY.search(str(meta.get(key, ""))) for key in ("cfg", "config")),
    )


def published_config(weights: ForeignWeights) -> str:
    """Return the name of the configuration that ships for this family of checkpoints.

    Raises:
        TrainingError: it is neither PointPillars nor PV-RCNN.
    """
    for name, config in CONFIG_OF.items():
        if name in weights.state:
            return config
    some = ", ".join(sorted({name.split(".")[0] for name in weights.state})[:8])
    raise TrainingError(
        f"{weights.path}: neither PointPillars nor PV-RCNN of OpenPCDet or mmdetection3d; it has the parts {some}"
    )


def write_imported(weights: ForeignWeights, config: Config, out: str | Path) -> int:
    """Write the weights as a checkpoint of `asca train`; return how many of the source's arrays were used.

    Args:
        weights: theirs.
        config: of the same model.
        out: a file, such as pointpillars.ckpt.

    Raises:
        ConfigError: `config` is of another family, has other classes, or what theirs cannot have.
        TrainingError: an array is missing, unknown, or of another shape; nothing is imported in part.
    """
    model, names = config.model, config.model.spec.class_names
    if not isinstance(model, PillarModel | PvRcnnModel):
        raise ConfigError(f"model.kind = {model.kind}: {weights.library} has none; give pillar or pv_rcnn")
    if len(weights.classes) == len(names) and tuple(map(str.casefold, weights.classes)) != tuple(
        map(str.casefold, names)
    ):
        raise ConfigError(
            f"{weights.path}: its classes are {', '.join(weights.classes)}, those of {config.name} {', '.join(names)}; "
            "give a YAML with --config that has its classes in its order"
        )
    prefix = "" if isinstance(model, PillarModel) else "network."
    our_state = {name.removeprefix(prefix): value for name, value in build_model(model).state_dict().items()}
    key_mappings = _key_mappings(weights, model, our_state)
    linked = {mapping.target for mapping in key_mappings}
    if more := [name for name in our_state if name not in linked and not name.endswith("num_batches_tracked")]:
        raise ConfigError(
            f"--config: {weights.library}'s model has no {more[0]}; switch off what {config.name} adds to it"
        )
    converted = convert_state(weights.state, key_mappings, our_state, str(weights.path))
    content = {
        "hyper_parameters": {"config": to_dict(config)},
        "global_step": weights.steps,
        "state_dict": {f"detector.{prefix}{name}": value for name, value in converted.items()},
    }
    write_plain(content, out)
    return len(weights.state)


def _key_mappings(
    weights: ForeignWeights, model: PillarModel | PvRcnnModel, our_state: Mapping[str, Tensor]
) -> list[KeyMapping]:
    if weights.library == "mmdetection3d":
        return list(mmdetection3d_keys(model, weights.state, our_state, legacy=weights.legacy))
    if isinstance(model, PillarModel):
        return list(pointpillars_keys(model, weights.state))
    return list(pv_rcnn_keys(model, weights.state, our_state))


class _Omitted:
    """Placeholder for an object of an unknown class; it accepts and drops what a pickle assigns to it."""

    def __new__(cls, *_: Any, **__: Any) -> "_Omitted":
        return super().__new__(cls)

    def __init__(self, *_: Any, **__: Any) -> None:
        pass

    def __setstate__(self, _: Any) -> None:
        pass


def load_weights_alone(path: Path) -> dict[str, Any]:
    """Read the dictionary in a file of `torch.save`, weights only: nothing in it is executed.

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
