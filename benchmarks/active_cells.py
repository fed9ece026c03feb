"""Active cells of a sparse neck, and the positive anchors among them.

    python -m benchmarks.active_cells FOLDER                 # KITTI layout, labelled
    python -m benchmarks.active_cells FOLDER --split training --whole-scans

Fractions are over all frames; the time is process time of the rulebook builder, the best of three for each frame.
"""

import time
from pathlib import Path
from typing import Annotated, get_args

import numpy as np
import typer
from numpy.typing import NDArray

from asca_pillars.base.system import cpu_model
from asca_pillars.cli.run_command import run_command
from asca_pillars.config.tree import load_config, pillar_spec
from asca_pillars.data.frames import read_frame, within_ranges
from asca_pillars.data.kitti import KittiSplit
from asca_pillars.detection.targets import assign_targets
from asca_pillars.evaluation.report_page import markdown_table
from asca_pillars.ops.pillar.grid import map_cells
from asca_pillars.ops.pillar.neck_rulebooks import MaskRule, NeckRulebookBuilder, NeckRulebooks
from asca_pillars.ops.pillar.spec import PillarSpec


def main(
    folder: Annotated[Path, typer.Argument(help="Folder in KITTI layout with labels.")],
    config: Annotated[str, typer.Option(help="YAML, or the name of one that ships.")] = "asca_small_sim",
    frame_list: Annotated[str, typer.Option("--split", help="A list in ImageSets/.")] = "val",
    limit: Annotated[int, typer.Option(help="Frames at most.")] = 200,
    whole_scans: Annotated[bool, typer.Option(help="Not cut to what the camera sees.")] = False,
) -> None:
    """Print a row for each rule."""
    spec = pillar_spec(load_config(config))
    split = KittiSplit(folder, frame_list)
    frames = [
        within_ranges(read_frame(split, name, spec.class_names, camera_view=not whole_scans, min_points=1), spec.ranges)
        for name in split.frame_ids[:limit]
    ]
    print(f"{cpu_model()}, {len(frames)} frames of {folder.name}, grid of {config}\n")
    rows = []
    for rule in get_args(MaskRule):
        builder = NeckRulebookBuilder(*spec.grid.map_shape, rule)
        counts = [_count(spec, builder, frame.points, frame.boxes, frame.labels) for frame in frames]
        positives, active, objects, lost, cells, time_ms = np.array([each[:6] for each in counts]).sum(axis=0)
        levels = np.mean([each[6] for each in counts], axis=0)
        shares = " / ".join(f"{share:.0%}" for share in levels)
        rows.append(
            (rule, shares, f"{cells / len(frames):.0f}", f"{active / positives:.1%}", f"{lost:.0f} of {objects:.0f}",
             f"{time_ms / len(frames):.2f}")
        )  # fmt: skip
    header = (
        "rule",
        "active at strides 2 / 4 / 8",
        "head cells",
        "positive anchors active",
        "objects without any",
        "ms",
    )
    print(markdown_table(header, rows, left=1))


def _count(
    spec: PillarSpec,
    builder: NeckRulebookBuilder,
    points: NDArray[np.float32],
    boxes: NDArray[np.float32],
    labels: NDArray[np.int64],
) -> tuple[int, int, int, int, int, float, list[float]]:
    """Return positive anchors, active ones, objects, objects without any, head cells, ms, active fraction by level."""
    pillars = spec.pillarize(points)
    pooled = map_cells(pillars.cells, spec.grid)
    cells = pillars.cells if pooled is None else pooled.cells
    targets = assign_targets(spec.anchors, spec.classes, boxes, labels)
    rulebooks, time_ms = _timed(builder, cells)
    active = np.isin(targets.positives // spec.anchors.shape[2], rulebooks.head_cells)
    matched = set(targets.matched.tolist())
    kept = set(targets.matched[active].tolist())
    head_cells = spec.anchors.shape[0] * spec.anchors.shape[1]
    shares = [len(level.cells) / (head_cells >> (2 * number)) for number, level in enumerate(rulebooks.levels)]
    counts = len(active), int(active.sum()), len(matched), len(matched - kept), len(rulebooks.head_cells)
    return *counts, time_ms, shares


def _timed(builder: NeckRulebookBuilder, cells: NDArray[np.int64]) -> tuple[NeckRulebooks[NDArray[np.int32]], float]:
    times_ms = []
    for _ in range(3):
        start = time.process_time()
        rulebooks = builder.build(cells)
        times_ms.append((time.process_time() - start) * 1e3)
    return rulebooks, min(times_ms)


if __name__ == "__main__":
    run_command(main)
