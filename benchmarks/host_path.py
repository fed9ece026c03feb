"""Time of the detector's stages outside its two graphs.

    python -m benchmarks.host_path [SCANS]...

Medians and quartiles over the rounds, milliseconds. Caches are as after a frame of the network: other data
has evicted the scan.
"""

import time
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer
from numpy.typing import NDArray

from asca_deploy import default_bundle_path, sample_scan_path
from asca_deploy.bundle import PillarBundle
from asca_deploy.detector import usable_points
from asca_deploy.manifest import load_pillar_bundle
from asca_pillars.base.system import cpu_model
from asca_pillars.cli.run_command import run_command
from asca_pillars.detection.decode import HeadMaps, rotated_nms
from asca_pillars.evaluation.report_page import markdown_table
from asca_pillars.ops.pillar.grid import map_cells
from asca_pillars.ops.pillar.neck_rulebooks import NeckRulebookBuilder
from asca_pillars.scans.input_check import check_input
from asca_pillars.scans.scan_reader import read_scan

CAMERA_VIEW = 0.84, 0.25  # |y| / x and |z| / x: approximate field of view of KITTI's camera 2
DISTURBANCE = np.zeros(4 << 20, np.float32)  # 16 MB
CANDIDATES = (100, 1000)


def main(
    scans: Annotated[list[Path] | None, typer.Argument(help="KITTI .bin files; default: the one that ships.")] = None,
    rounds: Annotated[int, typer.Option(help="Rounds.")] = 51,
) -> None:
    """Print a table for each scan, as it is and as the camera sees it, and one for suppression."""
    bundle = load_pillar_bundle(default_bundle_path())
    print(f"{cpu_model()}, bundle {bundle.name}, {rounds} rounds\n")
    for path in scans or [sample_scan_path()]:
        points = read_scan(path).points
        for view, part in (("full", points), ("camera view", points[camera_view(points)])):
            print(f"{path.name}, {view}: {len(part)} points")
            report(host_path(part, bundle), rounds)
    print("rotated NMS, 60 m by 60 m at nms_iou 0.01")
    report({f"{count} candidates": suppression(count) for count in CANDIDATES}, rounds)


def camera_view(points: NDArray[np.float32]) -> NDArray[np.bool_]:
    """Return the mask (N,) of points (N, >= 3), metres, LiDAR frame, in the camera's field of view."""
    seen = np.abs(points[:, 1:3]) <= points[:, :1] * np.array(CAMERA_VIEW, np.float32)
    return np.asarray(seen.all(axis=1))


def host_path(points: NDArray[np.float32], bundle: PillarBundle) -> dict[str, Callable[[], Any]]:
    """Return the stages of one frame; the head's maps are noise with 60 anchors above the threshold."""
    spec, rng = bundle.spec, np.random.default_rng(0)
    height, width, count, _ = spec.anchors.shape
    scores = rng.normal(-8, 1, (height, width, count)).astype(np.float32)
    scores.reshape(-1)[rng.choice(scores.size, 60, replace=False)] = 1.0
    boxes = rng.normal(0, 0.2, (height, width, 7 * count)).astype(np.float32)
    directions = rng.normal(0, 1, (height, width, 2 * count)).astype(np.float32)
    maps = HeadMaps(*(np.moveaxis(m, -1, 0) for m in (scores, boxes, directions)))
    pillars = spec.pillarize(points)
    counts, rule = pillars.stats, bundle.pillar.active_cells
    stages: dict[str, Callable[[], Any]] = {
        "input": lambda: (usable_points(points), check_input(points, counts, bundle.expected_input, None, spec.ranges)),
        "pillarize": lambda: spec.pillarize(points),
        "decode": lambda: spec.decode(maps),
    }
    if rule is not None:
        pooled, builder = map_cells(pillars.cells, spec.grid), NeckRulebookBuilder(*spec.grid.map_shape, rule)
        cells = pillars.cells if pooled is None else pooled.cells
        stages["tables"] = lambda: builder.build(cells)
    return stages


def suppression(count: int) -> Callable[[], Any]:
    """Return a call of NMS on boxes of the size of cars in all directions."""
    rng = np.random.default_rng(count)
    low, high = [0, -30, -1, 3.5, 1.5, 1.4, -np.pi], [60, 30, -0.5, 4.5, 2.0, 1.8, np.pi]
    boxes, scores = rng.uniform(low, high, (count, 7)).astype(np.float32), rng.random(count).astype(np.float32)
    return lambda: rotated_nms(boxes, scores, 0.01)


def report(stages: dict[str, Callable[[], Any]], rounds: int) -> None:
    """Time the stages and print them."""
    times_ms = np.array([[measure_ms(stage) for stage in stages.values()] for _ in range(rounds + 1)])
    if len(stages) > 2:
        times_ms = np.concatenate([times_ms, times_ms.sum(axis=1, keepdims=True)], axis=1)
    quarter, median, three_quarters = np.quantile(times_ms[1:], [0.25, 0.5, 0.75], axis=0)  # the first is not counted
    names = [*stages, "all"][: len(median)]
    cells = [f"{own[1]:.2f} ({own[0]:.2f}-{own[2]:.2f})" for own in zip(quarter, median, three_quarters, strict=True)]
    print(markdown_table(("stage", "ms"), list(zip(names, cells, strict=True)), left=1))


def measure_ms(stage: Callable[[], Any]) -> float:
    """Return the wall time of one call."""
    np.add(DISTURBANCE, 1, out=DISTURBANCE)
    start = time.perf_counter()
    stage()
    return (time.perf_counter() - start) * 1e3


if __name__ == "__main__":
    run_command(main)
