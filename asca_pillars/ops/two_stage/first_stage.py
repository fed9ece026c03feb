"""First-stage results that the second stage reads: proposals, keypoints and map features at the keypoints."""

from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from asca_pillars.base.errors import ConfigError
from asca_pillars.base.strict import Strict
from asca_pillars.detection.decode import HeadMaps
from asca_pillars.detection.detections import Detections
from asca_pillars.detection.proposals import ProposalSettings, propose
from asca_pillars.detection.spec import DetectorSpec
from asca_pillars.ops.points.sampling import bilinear_cells, farthest_points, points_near_boxes, read_map


class FirstStageOutputs(NamedTuple):
    """Outputs of a first stage for one scan."""

    maps: HeadMaps[NDArray[np.float32]]
    """Head maps, or rows of the head's active cells."""
    neck: NDArray[Any]
    """(H, W, C) the head's input on its map, or (M, C) at M active cells; beside these the map is zero. float32,
    or the uint8 steps of an 8-bit bundle."""
    cells: NDArray[np.int32] | None = None
    """(M,) flat index of the head cell of each row; None of maps."""


class FirstStage(Protocol):
    """Trained one-stage detector that also returns its neck's map: a bundle or a checkpoint."""

    @property
    def spec(self) -> DetectorSpec:
        """Grid and classes."""

    @property
    def identity(self) -> str:
        """Identifier of the trained weights, whichever file they come from."""

    def __call__(self, points: NDArray[np.float32]) -> FirstStageOutputs:
        """Run on one scan (N, 4)."""


@dataclass(frozen=True)
class KeypointSettings(Strict):
    """Settings for the choice of a scan's keypoints."""

    count: int = 768
    margin_m: float = 2.0
    """Largest distance of keypoints from the circles around the proposals."""

    def __post_init__(self) -> None:
        if self.count < 1 or not self.margin_m >= 0:
            raise ConfigError(
                f"keypoints: count {self.count} must be at least 1, margin_m {self.margin_m:g} at least 0"
            )


@dataclass(frozen=True)
class FirstStageSettings(Strict):
    """Settings of the first-stage results that the second stage reads."""

    proposals: ProposalSettings = field(default_factory=ProposalSettings)
    keypoints: KeypointSettings = field(default_factory=KeypointSettings)

    def scaled(self, factor: int) -> "FirstStageSettings":
        """Return settings with `factor` times the proposals and keypoints, for a range with as many more objects."""
        proposals = replace(
            self.proposals,
            candidates=self.proposals.candidates * factor,
            quotas=tuple(quota * factor for quota in self.proposals.quotas),
        )
        return replace(
            self, proposals=proposals, keypoints=replace(self.keypoints, count=self.keypoints.count * factor)
        )


@dataclass(frozen=True)
class SecondStageInputs:
    """First-stage results of one scan that the second stage reads."""

    proposals: Detections
    """R proposals."""
    keypoints: NDArray[np.float32]
    """(K, 3) positions in metres, LiDAR frame."""
    bev: NDArray[np.float32]
    """(K, C) the neck's map at the keypoints."""


def require_pillar_kind(source: object, kind: str) -> None:
    """Refuse a detector of another family than the pillar detector's.

    Args:
        source: bundle or checkpoint, to be named to the user.
        kind: family of the detector.

    Raises:
        ConfigError: the detector is of another family.
    """
    if kind != "pillar":
        raise ConfigError(f"{source}: model.kind {kind}; give a detector of kind pillar")


def run_first_stage(stage: FirstStage, points: NDArray[np.float32], settings: FirstStageSettings) -> SecondStageInputs:
    """Run the first stage on the finite points (N, 4) of one scan."""
    return second_stage_inputs(stage(points), points, stage.spec, settings)


def second_stage_inputs(
    outputs: FirstStageOutputs, points: NDArray[np.float32], spec: DetectorSpec, settings: FirstStageSettings
) -> SecondStageInputs:
    """Return the second stage's input, from the outputs of the first one for finite points (N, 4) of one scan."""
    proposals = propose(outputs.maps, spec, settings.proposals, outputs.cells)
    near = points_near_boxes(points, proposals.boxes, settings.keypoints.margin_m)
    keypoints = np.ascontiguousarray(near[farthest_points(near, settings.keypoints.count), :3])
    return SecondStageInputs(proposals, keypoints, _read_neck(outputs, keypoints, spec))


def _read_neck(outputs: FirstStageOutputs, keypoints: NDArray[np.float32], spec: DetectorSpec) -> NDArray[np.float32]:
    x_m, y_m = spec.head_centers_m()
    cells, weights = bilinear_cells(keypoints, x_m, y_m)
    rows = outputs.neck.reshape(-1, outputs.neck.shape[-1])
    if outputs.cells is not None:
        if not len(rows):
            return np.zeros((len(keypoints), rows.shape[1]), np.float32)
        row_of_cell = np.full(len(x_m) * len(y_m), -1, np.int32)
        row_of_cell[outputs.cells] = np.arange(len(rows))
        cells = row_of_cell[cells]
        weights, cells = np.where(cells < 0, np.float32(0), weights), np.maximum(cells, 0)
    return read_map(rows, cells, weights)
