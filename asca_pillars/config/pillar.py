"""The section `model` of the family `pillar`. Its defaults are the paper's values (section 4.1)."""

from dataclasses import dataclass, field
from typing import Literal

from asca_pillars.base.errors import ConfigError
from asca_pillars.base.strict import Strict, require_bounds
from asca_pillars.detection.targets import Assigner
from asca_pillars.ops.pillar.neck_rulebooks import MaskRule
from asca_pillars.ops.pillar.spec import PillarSpec

CpaReading = Literal["none", "paper", "channel", "point", "linear"]


@dataclass(frozen=True)
class NetworkConfig(Strict):
    """Widths and depths of the network.

    Attributes:
        cpa: reading of the correlative point attention, or the control `linear`, see docs/READING.md.
        pillar_channels: C, features of one pillar.
        block_channels: output channels of Block1..3 (Table 1).
        block_convs: stride-1 convolutions that follow each block's strided one (Table 1: 3).
        upsample_channels: output channels of each DeBlock (Table 1: 128).
        empty_slots: whether the rows of zeros with which OpenPCDet fills a pillar up to `limits.max_points` are part of
            its maximum; imported weights alone need it.
        neck: `dense` computes everywhere, `sparse` at active cells alone; the weights fit both.
        active_cells: which cells are active in a sparse neck, see `ops.pillar.neck_rulebooks`.
    """

    cpa: CpaReading = "channel"
    pillar_channels: int = 64
    block_channels: tuple[int, int, int] = (64, 128, 256)
    block_convs: tuple[int, int, int] = (3, 3, 3)
    upsample_channels: int = 128
    empty_slots: bool = False
    neck: Literal["dense", "sparse"] = "dense"
    active_cells: MaskRule = "fine"

    def __post_init__(self) -> None:
        require_bounds("model.network", self, ("pillar_channels", "block_channels", "upsample_channels"), low=1)
        require_bounds("model.network", self, ("block_convs",), low=0)
        if self.empty_slots and self.cpa == "point":
            raise ConfigError("model.network.empty_slots cannot be combined with cpa point; change one of them")
        if self.neck == "sparse" and self.active_cells == "fine" and not self.block_convs[0]:
            raise ConfigError(
                "model.network.active_cells = fine grows in the first block's stride-1 convolutions, of which "
                "model.network.block_convs has none; give it one, or set model.network.active_cells=sub"
            )


@dataclass(frozen=True)
class LossConfig(Strict):
    """Eq. (13)-(15) with the residuals of PointPillars; `smooth_l1_beta` is SECOND's 1/9.

    Attributes:
        score_target: what the class score of a positive anchor is to be: `one`, or the `iou` in 3D of the box that it
            predicts with the labelled one (quality focal loss, arXiv 2006.04388).
        assigner: which anchors are positive: by `overlap` with the thresholds of `model.spec.classes`, or by `atss`
            (arXiv 1912.02424), see `detection.targets.assign_targets`.
    """

    box_weight: float = 2.0
    class_weight: float = 1.0
    direction_weight: float = 0.2
    focal_alpha: float = 0.25
    focal_gamma: float = 2.0
    smooth_l1_beta: float = 1 / 9
    score_target: Literal["one", "iou"] = "one"
    assigner: Assigner = "overlap"

    def __post_init__(self) -> None:
        weights = ("box_weight", "class_weight", "direction_weight")
        require_bounds("model.loss", self, (*weights, "focal_gamma", "smooth_l1_beta"), low=0)
        require_bounds("model.loss", self, ("focal_alpha",), low=0, high=1)
        if self.score_target == "iou" and 0 < self.focal_gamma < 1:
            raise ConfigError(
                f"model.loss.focal_gamma = {self.focal_gamma:g}: with model.loss.score_target iou the gradient of a "
                "score that is right is not finite; give 0, or at least 1"
            )


TRACED_PILLARS = 6
"""Number of pillars in the example that an export traces the encoder with."""


@dataclass(frozen=True)
class PillarModel(Strict):
    """ASCA-PointPillars and PointPillars: one stage on pillars.

    Attributes:
        kind: family of the detector.
        spec: grid, limits, classes and post-processing, which training and the vehicle share.
        network: widths and depths.
        loss: weights of the loss.
    """

    kind: Literal["pillar"] = "pillar"
    spec: PillarSpec = field(default_factory=PillarSpec)
    network: NetworkConfig = field(default_factory=NetworkConfig)
    loss: LossConfig = field(default_factory=LossConfig)

    def __post_init__(self) -> None:
        if self.network.cpa == "paper" and self.spec.limits.max_pillars < TRACED_PILLARS:
            raise ConfigError(
                f"model.spec.limits.max_pillars = {self.spec.limits.max_pillars}: must be at least {TRACED_PILLARS} "
                "with cpa paper, whose weights are for exactly so many pillars"
            )
