"""The section `model` of the family `pillar_refine`: a frozen pillar detector and a second stage on its proposals."""

from dataclasses import dataclass, field
from typing import Literal

from asca_pillars.base.errors import ConfigError
from asca_pillars.base.strict import Strict, require_bounds
from asca_pillars.detection.decode import PostProcess
from asca_pillars.ops.pillar.spec import PillarSpec
from asca_pillars.ops.two_stage.decode import Scores
from asca_pillars.ops.two_stage.first_stage import FirstStageSettings
from asca_pillars.ops.two_stage.prepare import RefineSettings


@dataclass(frozen=True)
class RefineNetwork(Strict):
    """Widths of the second stage; none of them is PV-RCNN's, which are two to four times as large.

    Attributes:
        ball_widths: output channels of the MLP on the raw points of a ball around a keypoint.
        keypoint_channels: of a keypoint's fused feature.
        grid_widths: output channels of the MLP on the keypoints of a ball around a grid point.
        hidden: channels of the fully connected layers of the heads.
        dropout: share of their values that training drops.
    """

    ball_widths: tuple[int, ...] = (16, 32)
    keypoint_channels: int = 64
    grid_widths: tuple[int, ...] = (32, 32)
    hidden: int = 128
    dropout: float = 0.1

    def __post_init__(self) -> None:
        widths = ("ball_widths", "keypoint_channels", "grid_widths", "hidden")
        require_bounds("model.refine.network", self, widths, low=1)
        if not 0 <= self.dropout < 1:
            raise ConfigError(f"model.refine.network.dropout = {self.dropout:g}: must be at least 0 and less than 1")


@dataclass(frozen=True)
class RefineConfig(Strict):
    """The second stage.

    Attributes:
        seen: proposals and keypoints, all that it sees of the first stage; cached proposals belong to these values.
        neighbors: balls and grids.
        network: widths.
        rois: proposals of a frame that one training step learns from.
        scores: of refined boxes: `second`, the second stage's, which has seen the proposal's, or `both`, the geometric
            mean of the two.
    """

    seen: FirstStageSettings = field(default_factory=FirstStageSettings)
    neighbors: RefineSettings = field(default_factory=RefineSettings)
    network: RefineNetwork = field(default_factory=RefineNetwork)
    rois: int = 32
    scores: Scores = "second"

    def __post_init__(self) -> None:
        require_bounds("model.refine", self, ("rois",), low=2)


def require_no_votes(post: PostProcess) -> None:
    """Raise ConfigError if boxes of two stages are to vote: refined ones were better alone (docs/WEIGHTS.md)."""
    if post.vote_iou is not None:
        raise ConfigError(
            f"model.spec.post.vote_iou = {post.vote_iou:g}: the boxes of a second stage do not vote; leave it out"
        )


@dataclass(frozen=True)
class RefineModel(Strict):
    """A second stage that refines the proposals of a trained pillar detector, which stays as it is.

    Attributes:
        kind: family of the detector.
        first_stage: a checkpoint of a pillar detector, or a float32 bundle that holds one: its folder, or the name of
            one that ships.
        first_stage_identity: of its trained weights; `asca train` fills it in.
        bev_channels: of the first stage's map; `asca train` fills it in.
        spec: the first stage's, which `asca train` fills in; its score thresholds and suppression are those of the
            refined boxes.
        refine: the second stage.
    """

    kind: Literal["pillar_refine"] = "pillar_refine"
    first_stage: str = "default_float32"
    first_stage_identity: str = ""
    bev_channels: int = 0
    spec: PillarSpec = field(default_factory=PillarSpec)
    refine: RefineConfig = field(default_factory=RefineConfig)

    def __post_init__(self) -> None:
        quotas = self.refine.seen.proposals.quotas
        known = self.first_stage_identity != ""  # before, the spec is not the first stage's yet
        if known and len(quotas) != len(self.spec.classes):
            raise ConfigError(
                f"model.refine.seen.proposals.quotas = {list(quotas)}: give one for each of the classes "
                f"{', '.join(self.spec.class_names)}"
            )
        require_bounds("model", self, ("bev_channels",), low=0)
        require_no_votes(self.spec.post)
