"""The section `model` of the family `pv_rcnn`: a voxel detector whose second stage reads keypoints (PV-RCNN)."""

from dataclasses import dataclass, field
from typing import ClassVar, Literal

from asca_pillars.base.errors import ConfigError
from asca_pillars.base.strict import Strict, require_bounds
from asca_pillars.config.two_stage import require_no_votes
from asca_pillars.detection.proposals import AnchorProposals
from asca_pillars.ops.pv_rcnn.prepare import VoxelSetSettings
from asca_pillars.ops.pv_rcnn.spec import VoxelSpec
from asca_pillars.ops.two_stage.decode import Scores

Gate = Literal["none", "keypoint"]
Attention = Literal["none", "dual", "rda"]


@dataclass(frozen=True)
class PvRcnnNetwork(Strict):
    """Widths; the defaults are the published ones on KITTI.

    Attributes:
        voxel_channels: of conv1 to conv4 and of conv_out.
        block_channels: output channels of the two blocks of the map's backbone.
        block_convs: 3x3 convolutions that follow each block's first one.
        upsample_channels: output channels of each block after upsampling.
        source_widths: output channels of the MLP of each of `settings.sources`.
        scale_widths: channels of each of `settings.scale_radii_m`, where there are any.
        scale_channels: of a keypoint's feature from all of them.
        keypoint_channels: of a keypoint's fused feature.
        weighting_channels: of the hidden layers that weigh keypoints.
        grid_widths: output channels of the MLP on the keypoints around a grid point.
        vector_channels: of each cell of a cube, where `settings.vector_cells` is not 0 (VectorPool).
        hidden: channels of the fully connected layers of the second stage.
        dropout: share of their values that training drops.
        gate: `keypoint`: a gate on the raw points' features of each keypoint (Deformable PV-RCNN's context fusion).
        attention: after each block of the map's backbone: `rda`, AFE-RCNN's residual dual attention; `dual`, the same
            without its residual.
    """

    voxel_channels: tuple[int, int, int, int, int] = (16, 32, 64, 64, 128)
    block_channels: tuple[int, int] = (128, 256)
    block_convs: tuple[int, int] = (5, 5)
    upsample_channels: int = 256
    source_widths: tuple[tuple[int, ...], ...] = ((16, 16), (16, 16), (32, 32), (64, 64), (64, 64))
    scale_widths: tuple[int, ...] = (32, 64, 128)
    scale_channels: int = 64
    keypoint_channels: int = 128
    weighting_channels: int = 256
    grid_widths: tuple[int, ...] = (64, 64)
    vector_channels: int = 32
    hidden: int = 256
    dropout: float = 0.3
    gate: Gate = "none"
    attention: Attention = "none"

    def __post_init__(self) -> None:
        several = ("voxel_channels", "block_channels", "scale_widths", "grid_widths")
        single = ("upsample_channels", "scale_channels", "keypoint_channels", "weighting_channels", "vector_channels")
        require_bounds("model.network", self, (*several, *single, "hidden"), low=1)
        require_bounds("model.network", self, ("block_convs",), low=0)
        for number, widths in enumerate(self.source_widths):
            if min(widths, default=0) < 1:
                raise ConfigError(f"model.network.source_widths.{number} = {list(widths)}: must be at least 1")
        if not 0 <= self.dropout < 1:
            raise ConfigError(f"model.network.dropout = {self.dropout:g}: must be at least 0 and less than 1")


def _many_proposals() -> AnchorProposals:
    return AnchorProposals(candidates=9000, nms_iou=0.8, count=512)


@dataclass(frozen=True)
class PvRcnnModel(Strict):
    """PV-RCNN (arXiv 1912.13192): voxels, keypoints and two stages trained together.

    Attributes:
        kind: family of the detector.
        spec: grid, strides, classes and post-processing, which training and the vehicle share.
        settings: keypoints, proposals and neighbors, likewise.
        network: widths.
        training_proposals: which boxes of the first stage a training step draws from.
        rois: how many of them it draws for each frame.
        box_loss: of the second stage's boxes; `va` adds AFE-RCNN's BEV distance IoU to residuals and
            corners.
        scores: of refined boxes: `second`, the second stage's as published, or `both`, the geometric mean with the
            proposal's.
        train_first_stage: false: the first stage stays as `asca train --init` gives it, and the second alone is
            trained.
    """

    FIRST_STAGE: ClassVar[tuple[str, ...]] = ("voxels", "neck", "head")
    """Parts of the network that propose, by the names of `PvRcnn`."""

    kind: Literal["pv_rcnn"] = "pv_rcnn"
    spec: VoxelSpec = field(default_factory=VoxelSpec)
    settings: VoxelSetSettings = field(default_factory=VoxelSetSettings)
    network: PvRcnnNetwork = field(default_factory=PvRcnnNetwork)
    training_proposals: AnchorProposals = field(default_factory=_many_proposals)
    rois: int = 128
    box_loss: Literal["smooth_l1", "va"] = "smooth_l1"
    scores: Scores = "second"
    train_first_stage: bool = True

    def __post_init__(self) -> None:
        require_bounds("model", self, ("rois",), low=2)
        require_no_votes(self.spec.post)
        if len(self.network.source_widths) != len(self.settings.sources):
            raise ConfigError(
                f"model.network.source_widths has {len(self.network.source_widths)} entries: give one for each of "
                f"model.settings.sources {', '.join(sa.source for sa in self.settings.sources)}"
            )
        scales, widths = self.settings.scale_radii_m, self.network.scale_widths
        if scales and len(widths) != len(scales):
            raise ConfigError(
                f"model.network.scale_widths has {len(widths)} entries: give one for each of the {len(scales)} radii "
                "of model.settings.scale_radii_m"
            )
        if self.network.gate != "none" and "points" not in {sa.source for sa in self.settings.sources}:
            raise ConfigError(
                f"model.network.gate = {self.network.gate}: gates raw points; add `points` to model.settings.sources"
            )
