"""Measurement of a dataset against a configuration before training.

`measurements` measures a frame, this module a dataset, and `findings` lists its problems.
"""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from asca_pillars.base.errors import DatasetError, ScanError
from asca_pillars.base.progress import SILENT, Reporter
from asca_pillars.config.tree import DataConfig
from asca_pillars.data.frames import LabeledSplit
from asca_pillars.data.inspection.measurements import (
    ConventionFit,
    FrameMeasure,
    InspectedSpec,
    MatchOutcome,
    ScanMeasure,
    convention_fits,
    input_cells,
    measure_frame,
)
from asca_pillars.data.kitti import KittiSplit
from asca_pillars.data.yaw_units import check_yaws
from asca_pillars.detection.anchors import ClassSpec
from asca_pillars.detection.targets import Assigner
from asca_pillars.geometry.overlap import aligned_bev_iou
from asca_pillars.scans.input_check import AxesWarning


class Spread(NamedTuple):
    """Percentiles of a quantity: 10 % of the values are below `p10`, 10 % above `p90`."""

    p10: float
    median: float
    p90: float
    largest: float


@dataclass(frozen=True)
class ClassFacts:
    """Measurements of the labelled objects of one class.

    Attributes:
        boxes: number of boxes. Without any, their measurements are None.
        points: points inside one box; `no_points` boxes have none, `few_points` fewer than data.min_points.
        size_m: mean length, width and height; `size_std_m` their standard deviations.
        misfits: boxes that no anchor can overlap by positive_iou at any position: the size is too different.
        z_m: mean z of the centers, LiDAR frame.
        reach_m: lowest and highest x, y and z of the centers.
        outside_xyz: boxes whose center is outside the grid's range of x, of y, of z.
        cut_in_z: boxes whose top or bottom is outside the range of z.
        overlapped, forced, missed: boxes by their `MatchOutcome`; together the targets of training.
        positives: positive anchors.
    """

    name: str
    boxes: int
    points: Spread | None
    no_points: int
    few_points: int
    size_m: tuple[float, ...] | None
    size_std_m: tuple[float, ...] | None
    anchor_size_m: tuple[float, float, float]
    misfits: int
    z_m: float | None
    anchor_z_m: float
    reach_m: tuple[tuple[float, float], ...] | None
    outside_xyz: tuple[int, ...]
    cut_in_z: int
    overlapped: int
    forced: int
    missed: int
    positives: int


@dataclass(frozen=True)
class ScanFacts:
    """Measurements of the scans, and of their pillars or voxels before any limit.

    Attributes:
        points: points of a scan in training.
        dropped_points: stored points with a value that is not finite, `scans_with_dropped` the scans with any.
        scans_without_points: scans without a point inside the grid.
        outside_share: fraction of the points in training outside the grid.
        reflectance_stored: lowest and highest in the files.
        reflectance_scales: divisors of stored reflectances, and the number of scans of each.
        above_scale_share: mean fraction of a scan's points whose reflectance exceeds the scale and is clipped.
        reflectance: mean reflectance of a scan, in 0..1.
        ground_z_m: height of the ground near the sensor; None if it is visible in no scan.
        anchor_bottoms_m: lowest and highest bottom of the classes' anchors.
        cell: `pillar` or `voxel`.
        cells: of a scan; `scans_over_max_cells` have more than the detector's limit.
        fullest_cell: most points in any cell.
        crowded_share: fraction of the cells with more than max_points.
        cut_share: fraction of the points inside the grid that are dropped by max_points.
    """

    points: Spread
    dropped_points: int
    scans_with_dropped: int
    scans_without_points: int
    outside_share: float
    reflectance_stored: tuple[float, float]
    reflectance_scales: tuple[tuple[float, int], ...]
    above_scale_share: float
    reflectance: Spread
    ground_z_m: Spread | None
    anchor_bottoms_m: tuple[float, float]
    cell: str
    cells: Spread
    scans_over_max_cells: int
    fullest_cell: int
    crowded_share: float
    cut_share: float


@dataclass(frozen=True)
class Inspection:
    """Measurements of `frames` of a split's frames.

    `types` counts the labels by type, including types of no class; `damaged` has a line for each selected frame that
    cannot be read, `axes_warnings` a warning for each scan whose axes look wrong. A dataset of
    KITTI's layout cannot state its mounting (`states_mounting`). `conventions` states how well the points fit the boxes
    of the classes as labelled, turned, mirrored, raised and lowered; `yaws_doubt` is a sentence if the yaws do not look
    like radians.
    """

    data: str
    split: str
    frames: int
    frames_in_split: int
    frames_without_objects: int
    types: dict[str, int]
    classes: tuple[ClassFacts, ...]
    scans: ScanFacts
    damaged: tuple[str, ...]
    axes_warnings: tuple[AxesWarning, ...]
    states_mounting: bool
    conventions: tuple[ConventionFit, ...]
    yaws_doubt: str | None

    @property
    def sampled(self) -> bool:
        """True if frames of the split were left out."""
        return self.frames + len(self.damaged) < self.frames_in_split


def inspect_dataset(
    split: LabeledSplit,
    spec: InspectedSpec,
    data: DataConfig,
    *,
    assigner: Assigner = "overlap",
    frames: int = 500,
    reporter: Reporter = SILENT,
) -> Inspection:
    """Measure `frames` evenly spaced frames of a split, or all of them if there are fewer.

    Args:
        split: a list of a dataset.
        spec: grid, limits and classes of the detector.
        data: settings for reading the frames.
        assigner: assigner of anchors to boxes.
        frames: number of frames to measure.
        reporter: for the progress.

    Raises:
        DatasetError: a list, scan, calibration or label file is missing, anywhere in the split.
        DatasetError, ScanError: no frame can be read.
    """
    split.require_files()
    in_split = len(split.frame_ids)
    selected = min(frames, in_split)
    measured: list[FrameMeasure] = []
    damaged: list[DatasetError | ScanError] = []
    for number in reporter.track(range(selected), "Inspecting"):
        try:
            frame_id = split.frame_ids[number * in_split // selected]
            measured.append(measure_frame(split, frame_id, spec, data, assigner))
        except (DatasetError, ScanError) as error:
            damaged.append(error)
    if not measured:
        raise damaged[0]
    types = sum((frame.types for frame in measured), Counter[str]())
    return Inspection(
        data=str(split.root),
        split=split.name,
        frames=len(measured),
        frames_in_split=in_split,
        frames_without_objects=sum(not len(frame.boxes) for frame in measured),
        types=dict(types.most_common()),
        classes=tuple(_class_facts(measured, index, spec, data.min_points) for index in range(len(spec.classes))),
        scans=_scan_facts([frame.scan for frame in measured], spec),
        damaged=tuple(map(str, damaged)),
        axes_warnings=tuple(frame.axes for frame in measured if frame.axes is not None),
        states_mounting=not isinstance(split, KittiSplit),
        conventions=convention_fits(np.concatenate([frame.convention_points for frame in measured], axis=1)),
        yaws_doubt=check_yaws([frame.label_yaws for frame in measured]),
    )


def _class_facts(frames: Sequence[FrameMeasure], index: int, detector: InspectedSpec, min_points: int) -> ClassFacts:
    spec = detector.classes[index]
    of_class = np.concatenate([frame.labels for frame in frames]) == index
    boxes = np.concatenate([frame.boxes for frame in frames])[of_class].astype(np.float64)
    points = np.concatenate([frame.points for frame in frames])[of_class]
    outcomes = np.concatenate([frame.outcomes for frame in frames])[of_class]
    low, high = np.array(detector.ranges).T
    outside = (boxes[:, :3] < low) | (boxes[:, :3] >= high)
    cut = (boxes[:, 2] - boxes[:, 5] / 2 < low[2]) | (boxes[:, 2] + boxes[:, 5] / 2 > high[2])
    return ClassFacts(
        name=spec.name,
        boxes=len(boxes),
        points=spread(points),
        no_points=int((points == 0).sum()),
        few_points=int((points < min_points).sum()),
        size_m=tuple(boxes[:, 3:6].mean(axis=0).tolist()) if len(boxes) else None,
        size_std_m=tuple(boxes[:, 3:6].std(axis=0).tolist()) if len(boxes) else None,
        anchor_size_m=(spec.length_m, spec.width_m, spec.height_m),
        misfits=_misfits(boxes, spec),
        z_m=float(boxes[:, 2].mean()) if len(boxes) else None,
        anchor_z_m=spec.z_m,
        reach_m=tuple((float(axis.min()), float(axis.max())) for axis in boxes[:, :3].T) if len(boxes) else None,
        outside_xyz=tuple(outside.sum(axis=0).tolist()),
        cut_in_z=int(cut.sum()),
        overlapped=int((outcomes == MatchOutcome.OVERLAPPED).sum()),
        forced=int((outcomes == MatchOutcome.FORCED).sum()),
        missed=int((outcomes == MatchOutcome.MISSED).sum()),
        positives=int(sum(frame.positives[index] for frame in frames)),
    )


def _misfits(boxes: NDArray[np.float64], spec: ClassSpec) -> int:
    """Count the boxes below positive_iou even with an anchor of their own place and yaw."""
    in_place = boxes.copy()
    in_place[:, [0, 1, 6]] = 0
    anchor = np.array([[0, 0, 0, spec.length_m, spec.width_m, spec.height_m, 0]])
    return int((aligned_bev_iou(anchor, in_place) < spec.positive_iou).sum())


def _scan_facts(scans: Sequence[ScanMeasure], spec: InspectedSpec) -> ScanFacts:
    column = dict(zip(ScanMeasure._fields, np.array(scans, dtype=np.float64).T, strict=True))
    points, inside, cells, kind = column["points"], column["inside"].sum(), column["cells"], input_cells(spec)
    highest, ground = column["stored_reflectance_high"], column["ground_z_m"]
    bottoms = [item.z_m - item.height_m / 2 for item in spec.classes]
    return ScanFacts(
        points=_some(points),
        dropped_points=int(column["dropped"].sum()),
        scans_with_dropped=int((column["dropped"] > 0).sum()),
        scans_without_points=int((column["inside"] == 0).sum()),
        outside_share=_share(points.sum() - inside, points.sum()),
        reflectance_stored=(float(column["stored_reflectance_low"].min()), float(highest.max())),
        reflectance_scales=tuple(sorted(Counter(column["reflectance_scale"].tolist()).items())),
        above_scale_share=float(column["above_scale"].mean()),
        reflectance=_some(column["reflectance"]),
        ground_z_m=spread(ground[np.isfinite(ground)]),
        anchor_bottoms_m=(min(bottoms), max(bottoms)),
        cell=kind.name,
        cells=_some(cells),
        scans_over_max_cells=int((cells > kind.max_cells).sum()) if kind.max_cells is not None else 0,
        fullest_cell=int(column["fullest"].max()),
        crowded_share=_share(column["crowded"].sum(), cells.sum()),
        cut_share=_share(column["cut"].sum(), inside),
    )


def spread(values: NDArray[np.number]) -> Spread | None:
    """Return the percentiles of values (N,) of any unit; None without any."""
    return _some(values) if len(values) else None


def _some(values: NDArray[np.number]) -> Spread:
    return Spread(*np.percentile(values, (10, 50, 90, 100)).tolist())


def _share(part: float, whole: float) -> float:
    return float(part / whole) if whole else 0.0
