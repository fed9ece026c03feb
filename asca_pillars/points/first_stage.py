"""What the second stage asks of the first: proposals, keypoints and what the first stage's map says there."""

from dataclasses import dataclass, field
from typing import ClassVar, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from asca_pillars.errors import ConfigError
from asca_pillars.geometry.decode import HeadMaps
from asca_pillars.geometry.detections import Detections
from asca_pillars.geometry.detector_spec import DetectorSpec
from asca_pillars.points.bilinear import bilinear_cells, read_map
from asca_pillars.points.farthest_points import farthest_points, near_boxes
from asca_pillars.points.proposals import ProposalSettings, propose


class FirstPass(NamedTuple):
    """What a first stage computes of one scan."""

    maps: HeadMaps[NDArray[np.float32]]
    neck: NDArray[np.float32]
    """(H, W, C) the head's input, on the head's map."""


class FirstStage(Protocol):
    """A trained one-stage detector that hands out its neck's map: a bundle or a checkpoint."""

    @property
    def spec(self) -> DetectorSpec:
        """Grid and classes."""

    @property
    def identity(self) -> str:
        """Differs for different weights."""

    def __call__(self, points: NDArray[np.float32]) -> FirstPass:
        """Run on one scan (N, 4)."""


@dataclass(frozen=True)
class KeypointSettings:
    """Which points of a scan become keypoints."""

    count: int = 768
    margin_m: float = 2.0
    """They stand within this distance of the circles around the proposals; others would say nothing about them."""

    __pydantic_config__: ClassVar[dict[str, str]] = {"extra": "forbid"}

    def __post_init__(self) -> None:
        if self.count < 1 or not self.margin_m >= 0:
            raise ConfigError(
                f"keypoints: count {self.count} must be at least 1, margin_m {self.margin_m:g} at least 0"
            )


@dataclass(frozen=True)
class FirstStageSettings:
    """All that decides what the second stage sees of the first."""

    proposals: ProposalSettings = field(default_factory=ProposalSettings)
    keypoints: KeypointSettings = field(default_factory=KeypointSettings)

    __pydantic_config__: ClassVar[dict[str, str]] = {"extra": "forbid"}


@dataclass(frozen=True)
class Proposed:
    """What the second stage sees of the first's work on one scan."""

    proposals: Detections
    """R of them."""
    keypoints: NDArray[np.float32]
    """(K, 3) positions in metres, LiDAR frame."""
    bev: NDArray[np.float32]
    """(K, C) the neck's map at the keypoints."""


def require_dense_map(source: object, kind: str, neck: str, *, pooled: bool) -> None:
    """Refuse a detector whose neck has no map over the pillars' own cells for keypoints to read.

    Args:
        source: bundle or checkpoint, to be named to the user.
        kind: family of the detector.
        neck: `dense` or `sparse`.
        pooled: whether its map is another one than the pillars' own.

    Raises:
        ConfigError: the detector cannot be a first stage.
    """
    if kind != "pillar":
        raise ConfigError(f"{source}: model.kind {kind}; a first stage is of kind pillar")
    if neck != "dense" or pooled:
        raise ConfigError(
            f"{source}: a {neck} neck on a {'pooled' if pooled else 'warped'} map; a first stage has a dense neck and "
            "a warped map: train one so"
        )


def propose_on(stage: FirstStage, points: NDArray[np.float32], settings: FirstStageSettings) -> Proposed:
    """Run the first stage on the finite points (N, 4) of one scan."""
    return proposed_from(stage(points), points, stage.spec, settings)


def proposed_from(
    found: FirstPass, points: NDArray[np.float32], spec: DetectorSpec, settings: FirstStageSettings
) -> Proposed:
    """What the second stage sees of `found`, the first stage's answer to the finite points (N, 4) of one scan."""
    maps, neck = found
    proposals = propose(maps, spec, settings.proposals)
    near = points[near_boxes(points, proposals.boxes, settings.keypoints.margin_m)]
    keypoints = np.ascontiguousarray(near[farthest_points(near, settings.keypoints.count), :3])
    cells, weights = bilinear_cells(keypoints, *spec.head_centers_m())
    return Proposed(proposals, keypoints, read_map(neck.reshape(-1, neck.shape[2]), cells, weights))
