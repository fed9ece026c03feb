"""The PointPillars of OpenPCDet, and the first layer of mmdetection3d's, as ours.

Their points have a tenth feature, the height above the pillar's center. All pillars have the same center height, so the
feature is z less a constant: its weight joins that of z, and the constant joins the mean of the normalization. An empty
slot has zeros in all ten, the height of the center included, and so it keeps its own value before the normalization.

In mmdetection3d (`legacy`) the offsets to the pillar's center also take the place of x, y and z: their weights join.
"""

from collections.abc import Iterator, Mapping

from torch import Tensor

from asca_pillars.base.errors import TrainingError
from asca_pillars.config.pillar import PillarModel
from asca_pillars.models.openpcdet.key_mapping import KeyMapping, map_backbone_keys, norm_keys
from asca_pillars.ops.pillar.prepare import FEATURES

_Z = FEATURES.index("z")
_X_CENTER, _Z_CENTER = FEATURES.index("x_center"), len(FEATURES)  # the last is the one feature that ours does not have


def pointpillars_keys(model: PillarModel, state: Mapping[str, Tensor]) -> Iterator[KeyMapping]:
    """Yield the mappings for `build_pillar_detector(model)` from `state`, OpenPCDet's unitless weights (out, in, ...).

    Raises:
        TrainingError: points with other features.
    """
    yield from encoder_keys(model, state, "vfe.pfn_layers.0")
    yield from map_backbone_keys(model.network.block_convs)


def encoder_keys(
    model: PillarModel, state: Mapping[str, Tensor], layer: str, *, legacy: bool = False
) -> Iterator[KeyMapping]:
    """Yield the key mappings of the layer on points.

    Args:
        model: ours.
        state: their unitless weights (out, in, ...) by name.
        layer: their name of it.
        legacy: whether the offsets to the pillar's center also stand in the place of x, y and z.

    Raises:
        TrainingError: points with other features.
    """
    name = f"{layer}.linear.weight"
    low_m, high_m = model.spec.grid.z_range_m
    shape = tuple(state[name].shape) if name in state else None
    if shape is not None and (len(shape) != 2 or shape[1] != _Z_CENTER + 1):
        raise TrainingError(
            f"{name} has shape {shape}: its points must have {_Z_CENTER + 1} features, x, y, z, intensity and six "
            "offsets; others cannot be imported"
        )

    def explicit(weight: Tensor) -> Tensor:
        """Return their weight (out, 10) of x, y, z themselves and of their offsets, each once."""
        weight = weight.clone()
        if legacy:
            weight[:, _X_CENTER:] += weight[:, : _Z + 1]
            weight[:, : _Z + 1] = 0
        return weight

    def of_height(weight: Tensor) -> Tensor:
        return explicit(weight)[:, _Z_CENTER] * ((low_m + high_m) / 2)

    def linear(weight: Tensor) -> Tensor:
        merged = explicit(weight)
        merged[:, _Z] += merged[:, _Z_CENTER]
        return merged[:, :_Z_CENTER]

    yield KeyMapping(name, "encode.linear.weight", linear)
    for mapping in norm_keys(f"{layer}.norm", "encode.norm"):
        if mapping.target.endswith("running_mean"):
            yield mapping._replace(convert=lambda mean: mean + of_height(state[name]))
        else:
            yield mapping
    if model.network.empty_slots:
        yield KeyMapping(name, "encode.empty_slot", of_height)
