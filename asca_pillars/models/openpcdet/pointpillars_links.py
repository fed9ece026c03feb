"""OpenPCDet's PointPillars as ours.

Its points have a tenth feature, the height above the pillar's center. All pillars have the same center height, so the
feature is z less a constant: its weight joins that of z, and the constant joins the mean of the normalization. An empty
slot has zeros in all ten, the height of the center included, and so it keeps its own value before the normalization.
"""

from collections.abc import Iterator, Mapping

from torch import Tensor

from asca_pillars.errors import TrainingError
from asca_pillars.models.openpcdet.links import Link, norm_links
from asca_pillars.models.openpcdet.map_links import map_links
from asca_pillars.pillar_config import PillarModel
from asca_pillars.pillars.pillarize import FEATURES

_LINEAR, _NORM = "vfe.pfn_layers.0.linear.weight", "vfe.pfn_layers.0.norm"
_Z = FEATURES.index("z")
_Z_CENTER = len(FEATURES)  # the one feature that ours does not have


def pointpillars_links(model: PillarModel, state: Mapping[str, Tensor]) -> Iterator[Link]:
    """Links for `build_pillar_detector(model)`; `state` has their unitless weights (out, in, ...) by name.

    Raises:
        TrainingError: points with other features.
    """
    low_m, high_m = model.spec.grid.z_range_m
    shape = tuple(state[_LINEAR].shape) if _LINEAR in state else None
    if shape is not None and (len(shape) != 2 or shape[1] != _Z_CENTER + 1):
        raise TrainingError(
            f"{_LINEAR} has shape {shape}: its points must have {_Z_CENTER + 1} features, x, y, z, intensity and six "
            "offsets; others cannot be imported"
        )

    def of_height(_: Tensor) -> Tensor:
        return state[_LINEAR][:, _Z_CENTER] * ((low_m + high_m) / 2)

    def linear(weight: Tensor) -> Tensor:
        merged = weight[:, :_Z_CENTER].clone()
        merged[:, _Z] += weight[:, _Z_CENTER]
        return merged

    yield Link(_LINEAR, "encode.linear.weight", linear)
    for link in norm_links(_NORM, "encode.norm"):
        if link.target.endswith("running_mean"):
            yield link._replace(convert=lambda mean: mean + of_height(mean))
        else:
            yield link
    if model.network.empty_slots:
        yield Link(_LINEAR, "encode.empty_slot", of_height)
    yield from map_links(model.network.block_convs)
