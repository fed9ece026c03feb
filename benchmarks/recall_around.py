"""Recall by direction of a model that looks ahead, with the scan rotated for each pass.

    asca simulate data/around -n 300 --view around --seed 177
    python -m benchmarks.recall_around data/around

Three results, each with a 95 % interval:

- recall as measured, by direction;
- recall for equal objects: weighted as if every direction had the same objects, by distance, points and occlusion. The
  remaining difference is an effect of the direction itself;
- with --turn, the same scans rotated before detection. Differences that rotate with the street are of the scene,
  those that stay with the pass are of the method.

Objects with at least FEWEST_POINTS points, within RANGE_M, are counted. One is found if a detection of its class
overlaps it by `evaluation.recall.BEV_IOU` in bird's-eye view; a detection matches one object.
"""

import math
from pathlib import Path
from typing import Annotated, NamedTuple

import numpy as np
import typer
from numpy.typing import NDArray
from rich.progress import track

from asca_deploy import Detector
from asca_pillars.cli.run_command import run_command
from asca_pillars.data.kitti import KittiSplit, boxes_from_objects, objects_3d
from asca_pillars.detection.targets import match_by_overlap
from asca_pillars.evaluation.kitti.operating_point import wilson_interval
from asca_pillars.evaluation.recall import BEV_IOU, SMALL_BEV_IOU
from asca_pillars.evaluation.report_page import markdown_table
from asca_pillars.geometry.boxes import points_in_boxes
from asca_pillars.geometry.frame_change import FrameChange
from asca_pillars.geometry.overlap import bev_iou

FEWEST_POINTS = 5
RANGE_M = 40.0
DIRECTIONS = ("ahead", "left", "behind", "right")
SECTOR_DEG = 90.0
SEAM_DEG = 6.0
DISTANCE_STEPS_M = (12.0, 20.0, 30.0)
POINT_STEPS = (20, 60, 200)
REPEATS = 1000
_Flags = NDArray[np.bool_]


class Objects(NamedTuple):
    """Labelled objects of one class, all frames (N,)."""

    frame: NDArray[np.int64]
    bearing_deg: NDArray[np.float64]
    """Counter-clockwise from straight ahead in the recorded scan."""
    distance_m: NDArray[np.float64]
    points: NDArray[np.int64]
    occluded: NDArray[np.int64]
    """KITTI's state, 0 to 3."""
    found: _Flags

    @property
    def direction(self) -> NDArray[np.int64]:
        """(N,) index into DIRECTIONS."""
        return np.round(self.bearing_deg / SECTOR_DEG).astype(np.int64) % len(DIRECTIONS)

    @property
    def stratum(self) -> NDArray[np.int64]:
        """(N,) stratum of distance, points and occlusion."""
        near = np.searchsorted(DISTANCE_STEPS_M, self.distance_m)
        dense = np.searchsorted(POINT_STEPS, self.points, side="right")
        return np.asarray((near * 8 + dense) * 8 + np.minimum(self.occluded, 2))


def main(
    data: Annotated[Path, typer.Argument(help="What `asca simulate --view around` wrote.")],
    bundle: Annotated[str | None, typer.Option("--bundle", "-b", help="Default: the one that ships.")] = None,
    frames: Annotated[int | None, typer.Option("--frames", "-n", help="Default: all.")] = None,
    turn: Annotated[float, typer.Option(help="Degrees by which every scan is turned before it is detected.")] = 0.0,
) -> None:
    """Print recall by direction, raw and for equal objects."""
    detector = Detector(bundle, view="around")
    split = KittiSplit(data)
    chosen = split.frame_ids[:frames]
    rows: dict[str, list[Objects]] = {name: [] for name in detector.spec.class_names}
    twice = 0
    turned = FrameChange.turn(math.radians(turn))
    for number, frame_id in enumerate(track(chosen)):
        points = split.points(frame_id, camera_view=False)
        found = detector(turned.points(points))
        for name, of_frames in rows.items():
            boxes = turned.inverse.boxes(found.boxes[found.labels == detector.spec.class_names.index(name)])
            objects, doubles = _match(split, frame_id, number, name, points, boxes)
            of_frames.append(objects)
            twice += doubles
    print(f"{len(chosen)} revolutions turned by {turn:g} degrees, {detector.folder.name} in {detector.passes} passes\n")
    for name, of_frames in rows.items():
        merged = Objects(*(np.concatenate(column) for column in zip(*of_frames, strict=True)))
        print(_table(name, merged), end="\n\n")
    print(f"{twice} objects were found twice")


def _match(
    split: KittiSplit, frame_id: str, number: int, name: str, points: NDArray[np.float32], boxes: NDArray[np.float32]
) -> tuple[Objects, int]:
    """Return the objects of a class in one frame, and the number of those overlapped by more than one detection."""
    own = [item for item in objects_3d(split.objects(frame_id)) if item.type == name]
    truth = boxes_from_objects(own, split.calibration(frame_id))
    inside = points_in_boxes(points, truth).sum(axis=0)
    distance = np.hypot(truth[:, 0], truth[:, 1])
    iou = bev_iou(boxes, truth)
    least = BEV_IOU.get(name, SMALL_BEV_IOU)
    found = np.zeros(len(own), dtype=bool)
    found[match_by_overlap(iou, least)[1]] = True
    kept = (inside >= FEWEST_POINTS) & (distance <= RANGE_M)
    columns = (
        np.full(len(own), number),
        np.degrees(np.arctan2(truth[:, 1], truth[:, 0])).astype(np.float64),
        distance.astype(np.float64),
        inside.astype(np.int64),
        np.array([item.occluded for item in own], np.int64),
        found,
    )
    return Objects(*(column[kept] for column in columns)), int(((iou >= least).sum(axis=0) > 1).sum())


def _table(name: str, objects: Objects) -> str:
    direction = objects.direction
    beside = direction % 2 == 1
    off_seam = np.abs((objects.bearing_deg % SECTOR_DEG) - SECTOR_DEG / 2)
    groups = {"ahead": direction == 0, "left": direction == 1, "right": direction == 3, "beside": beside}
    groups |= {"behind": direction == 2, f"within {SEAM_DEG:g} degrees of a seam": off_seam < SEAM_DEG}
    rows = []
    for title, own in groups.items():
        hits, count = int(objects.found[own].sum()), int(own.sum())
        low, high = wilson_interval(hits, count)
        cells = [title, str(count), _percent(hits / max(count, 1)), f"{_percent(low)} to {_percent(high)}"]
        if title != "ahead":
            raw, alike = _differences(objects, own, groups["ahead"])
            cells += [_points(raw), _points(alike)]
        rows.append((*cells, *([""] * (6 - len(cells)))))
    columns = (name, "objects", "recall", "95 %", "less ahead's", "like for like")
    return markdown_table(columns, rows, left=1)


def _differences(objects: Objects, own: _Flags, ahead: _Flags) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return recall minus that ahead, raw and for equal objects: each (3,) with its bootstrap interval."""
    rng = np.random.default_rng(0)
    frames = int(objects.frame.max(initial=0)) + 1
    _, stratum = np.unique(objects.stratum, return_inverse=True)
    raw, alike = [], []
    for repeat in range(REPEATS + 1):
        drawn = rng.integers(0, frames, frames) if repeat else np.arange(frames)  # first all revolutions once
        each = np.bincount(drawn, minlength=frames).astype(np.float64)[objects.frame]
        raw.append(_recall(objects.found, each * own) - _recall(objects.found, each * ahead))
        alike.append(_alike(objects.found, stratum, each * own, each * ahead))
    return _interval(raw), _interval(alike)


def _recall(found: _Flags, weight: NDArray[np.float64]) -> float:
    return float(weight @ found / max(weight.sum(), 1e-9))


def _alike(found: _Flags, stratum: NDArray[np.int64], own: NDArray[np.float64], ahead: NDArray[np.float64]) -> float:
    """Return the difference of recall within each stratum that both sides have, averaged over the objects of both."""
    counts = [np.bincount(stratum, weight) for weight in (own, ahead)]
    hits = [np.bincount(stratum, weight * found) for weight in (own, ahead)]
    both = (counts[0] > 0) & (counts[1] > 0)
    difference = hits[0][both] / counts[0][both] - hits[1][both] / counts[1][both]
    total = (counts[0] + counts[1])[both]
    return float(difference @ total / max(total.sum(), 1e-9))


def _interval(values: list[float]) -> NDArray[np.float64]:
    return np.array([values[0], *np.percentile(values[1:], [2.5, 97.5])])


def _percent(share: float) -> str:
    return f"{100 * share:.0f} %"


def _points(values: NDArray[np.float64]) -> str:
    return "{:+.1f} ({:+.1f} to {:+.1f})".format(*(100 * values))


if __name__ == "__main__":
    run_command(main)
