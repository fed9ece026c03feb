"""Another sensor: recall by direction, mistakes that are noticed and mended, simulated sweeps beside a real one.

asca simulate data/around -n 300 --view around --seed 177
python -m benchmarks.sensors recall data/around
python -m benchmarks.sensors mistakes data/kitti/training/velodyne
python -m benchmarks.sensors sweep SWEEP.pcd.bin -c hdl_32e           # nuScenes: float32 x, y, z, intensity, ring
python -m benchmarks.sensors sweep SWEEP.feather -c vlp_32c_pair      # Argoverse 2; needs pyarrow
"""

import re
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, NamedTuple

import numpy as np
import typer
import yaml
from numpy.typing import NDArray
from rich.progress import track

from asca_deploy import Detections, Detector
from asca_pillars.base.errors import AscaError
from asca_pillars.base.schema import parse
from asca_pillars.cli.run_command import run_command
from asca_pillars.data.kitti import KittiSplit, boxes_from_objects, objects_3d
from asca_pillars.detection.targets import match_by_overlap
from asca_pillars.evaluation.kitti.score_threshold import wilson_interval
from asca_pillars.evaluation.recall import BEV_IOU, SMALL_BEV_IOU
from asca_pillars.evaluation.report_page import markdown_table
from asca_pillars.geometry.boxes import points_in_boxes
from asca_pillars.geometry.overlap import bev_iou
from asca_pillars.scans.find_scans import find_scans
from asca_pillars.scans.mounting import Mounting
from asca_pillars.scans.scan_reader import read_scan
from asca_pillars.scans.scan_settings import ScanInput, ScanSettings
from asca_pillars.sim.simulation import load_simulation_config, simulate_frame

FEWEST_POINTS, RANGE_M, SEAM_DEG = 5, 40.0, 6.0  # of the objects that `recall` counts; about a border of two passes
SAME_BOX_IOU = 0.5
NEAREST_M = 2.5  # nearer returns are mostly of the own car
BANDS_M = (0, 10, 20, 30, 50, np.inf)
UP_LIDAR_M = (1.35018, 0.0, 1.64042)  # Argoverse 2: the upper sensor in the vehicle's frame

Points = NDArray[np.float32]
app = typer.Typer(no_args_is_help=True, add_completion=False)


@app.command()
def recall(
    data: Annotated[Path, typer.Argument(help="What `asca simulate --view around` wrote.")],
    bundle: Annotated[str | None, typer.Option("--bundle", "-b", help="Default: the one that ships.")] = None,
    frames: Annotated[int | None, typer.Option("--frames", "-n", help="Default: all.")] = None,
) -> None:
    """Print the share of labelled objects found with --around by direction, with its 95 % interval."""
    detector, split = Detector(bundle, view="around"), KittiSplit(data)
    names = detector.spec.class_names
    seen: dict[str, list[NDArray[np.float64]]] = {name: [np.empty((0, 2))] for name in names}
    for frame_id in track(split.frame_ids[:frames]):
        points = split.points(frame_id, camera_view=False)
        found = detector(points)
        for label, name in enumerate(names):
            seen[name].append(_bearings(split, frame_id, name, points, found.boxes[found.labels == label]))
    rows = []
    for name, parts in seen.items():
        bearing_deg, hit = np.concatenate(parts).T
        quarter = np.round(bearing_deg / 90) % 4  # ahead, left, behind, right
        groups = quarter == 0, quarter % 2 == 1, quarter == 2, np.abs(bearing_deg % 90 - 45) < SEAM_DEG
        rows.append((f"{name} ({len(hit)})", *(_share(int(hit[own].sum()), int(own.sum())) for own in groups)))
    print(f"{len(split.frame_ids[:frames])} revolutions, {detector.folder.name}, passes: {detector.passes}\n")
    print(
        markdown_table(
            ("", "ahead", "left and right", "behind", f"within {SEAM_DEG:g} degrees of 45 and 135 degrees"),
            rows,
            left=1,
        )
    )


def _bearings(split: KittiSplit, frame_id: str, name: str, points: Points, boxes: Points) -> NDArray[np.float64]:
    """Return the bearing in degrees of each object of a class in one frame, and whether a box is of it: (N, 2)."""
    own = [item for item in objects_3d(split.objects(frame_id)) if item.type == name]
    truth = boxes_from_objects(own, split.calibration(frame_id))
    hit = np.zeros(len(own))
    hit[match_by_overlap(bev_iou(boxes, truth), BEV_IOU.get(name, SMALL_BEV_IOU))[1]] = 1
    kept = points_in_boxes(points, truth).sum(axis=0) >= FEWEST_POINTS
    kept &= np.hypot(truth[:, 0], truth[:, 1]) <= RANGE_M
    return np.column_stack([np.degrees(np.arctan2(truth[:, 1], truth[:, 0])), hit])[kept]


def _share(hits: int, count: int) -> str:
    low, high = wilson_interval(hits, count)
    return f"{100 * hits / max(count, 1):.0f} % ({100 * low:.0f} to {100 * high:.0f})"


class Mistake(NamedTuple):
    """A scan written as by another sensor: (N, 4) right -> (N, 4 or 5) in the file, and the mounting that mends it."""

    make: Callable[[Points], Points]
    mounting: Mounting = Mounting()


def _turned(axes: str) -> Mistake:
    mounting = Mounting(axes=axes)
    return Mistake(mounting.level.inverse.points, mounting)


def _scaled(scale: float) -> Mistake:
    return Mistake(lambda points: np.column_stack([points[:, :3], np.round(points[:, 3] * scale)]))


MISTAKES = {
    "none": Mistake(lambda points: points),
    "z = 0 on the ground": Mistake(
        lambda points: points + np.array([0, 0, 1.73, 0], np.float32), Mounting(sensor_height_m=0.0)
    ),
    "y forward": _turned("y-forward"),
    "z down": _turned("x,-y,-z"),
    "reflectance 0..100": _scaled(100),
    "reflectance 0..255": _scaled(255),
    "five columns": Mistake(lambda points: np.column_stack([points, np.arange(len(points)) % 64])),
}


@app.command()
def mistakes(scans: Annotated[Path, typer.Argument(help="Right scans of the sensor of the training.")]) -> None:
    """Print how often each mistake is noticed, and how many boxes of the right scans its named remedy brings back."""
    files = find_scans(scans)
    right = [Detector()(read_scan(path).points) for path in files]
    total, rows = sum(map(len, right)), []
    for name, mistake in MISTAKES.items():
        tried = [_try(path, mistake, boxes) for path, boxes in zip(track(files, name), right, strict=True)]
        noticed, before, after = np.sum(tried, axis=0)
        rows.append((name, f"{noticed} of {len(files)}", str(before), str(after)))
    print(f"{len(files)} scans, {total} boxes\n")
    print(markdown_table(("mistake", "noticed", "boxes before", "with the remedy"), rows, left=1))


def _try(path: Path, mistake: Mistake, right: Detections) -> tuple[int, int, int]:
    """Return whether it is noticed, and the right scan's boxes that are found before and with the remedy."""
    with tempfile.TemporaryDirectory() as folder:
        wrong = Path(folder) / "scan.bin"
        mistake.make(read_scan(path).points).astype("<f4").tofile(wrong)
        texts, found = _detect(wrong, ScanSettings())
        options = dict(re.findall(r"\(--([a-z-]+) (\S+?)(?: or auto)?\)", " ".join(texts)))
        named = {name.replace("-", "_"): yaml.safe_load(value) for name, value in options.items()}
        _, mended = _detect(wrong, parse(ScanSettings, named, "remedy"))
    own = mistake.mounting.to_model(Detector().bundle.expected_input.sensor_height_m)
    counts = []
    for one in (found, mended):
        same = right.labels[:, None] == one.labels[None]
        counts.append(int((same & (bev_iou(right.boxes, own.boxes(one.boxes)) >= SAME_BOX_IOU)).any(axis=1).sum()))
    return int(bool(texts)), counts[0], counts[1]


def _detect(path: Path, settings: ScanSettings) -> tuple[list[str], Detections]:
    try:
        scan_input = ScanInput(settings, [path])
        scan = scan_input.read(path)
    except AscaError as error:
        return [str(error)], Detections.empty(())
    found = Detector(mounting=scan_input.mounting)(scan.points)
    warnings = [text for text in found.report.warnings if "--around" not in text]  # also true of the right one
    return [*scan_input.notes, *scan.notes.remarks, *warnings], found


@app.command()
def sweep(
    path: Annotated[Path, typer.Argument(help="A .pcd.bin of nuScenes or a .feather of Argoverse 2.")],
    config: Annotated[str, typer.Option("--config", "-c", help="Simulated sensor.")] = "hdl_32e",
    frames: Annotated[int, typer.Option(help="Simulated scans.")] = 12,
) -> None:
    """Print returns, ranges and reflectances of both; one sweep is one street, so ranges may be of the place."""
    settings = load_simulation_config(config, "full")
    simulated = [_describe(simulate_frame(0, index, settings).points) for index in range(frames)]
    rows = []
    for name, value in _describe(read_sweep(path)).items():
        ours = [scan[name] for scan in simulated]
        rows.append((name, f"{value:.3g}", f"{np.mean(ours):.3g}", f"{min(ours):.3g} to {max(ours):.3g}"))
    print(markdown_table(("", path.name, f"{frames} scans of {config}", "lowest to highest"), rows, left=1))


def read_sweep(path: Path) -> Points:
    """Read points (N, 4) of a sweep: x, y, z about the sensor, reflectance 0..0.99 (0..100 is divided by 100)."""
    if path.suffix == ".feather":
        from pyarrow import feather

        table = feather.read_table(path)
        columns = [table[name].to_numpy().astype(np.float32) for name in ("x", "y", "z", "intensity")]
        points = np.stack(columns, axis=1) - np.array([*UP_LIDAR_M, 0.0], np.float32)
    else:
        points = np.fromfile(path, np.float32).reshape(-1, 5)[:, :4]
    points[:, 3] = np.clip(points[:, 3] / 100.0, 0.0, 0.99)
    return points


def _describe(points: Points) -> dict[str, float]:
    distance = np.linalg.norm(points[:, :3], axis=1)
    points, distance = points[distance > NEAREST_M], distance[distance > NEAREST_M]
    rows = {f"points beyond {NEAREST_M} m, thousands": len(points) / 1000}
    for low, count in zip(BANDS_M, np.histogram(distance, BANDS_M)[0], strict=False):
        rows[f"share from {low:g} m on"] = count / len(points)
    return rows | {f"reflectance, {share} %": float(np.percentile(points[:, 3], share)) for share in (25, 50, 75, 95)}


if __name__ == "__main__":
    run_command(app)
