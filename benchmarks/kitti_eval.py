"""Time and memory of the KITTI evaluation on synthetic frames, compared with a brute-force reference.

    python -m benchmarks.kitti_eval

As many frames as in KITTI's validation split, with about as many objects; most detections are objects detected two or
three times, as before suppression. The reference evaluates a few of the frames and must agree.
"""

import math
import time
from dataclasses import fields
from itertools import pairwise
from typing import Annotated

import numpy as np
import typer
from numpy.typing import NDArray
from rich.console import Console

from asca_deploy.benchmark.bench_report import peak_memory_mib
from asca_pillars.cli.run_command import run_command
from asca_pillars.evaluation.kitti.average_precision import CLASS_NAMES, DIFFICULTIES, KittiResults, evaluate
from asca_pillars.evaluation.kitti.objects import FrameObjects
from tests.evaluation.kitti.brute_force import ReferenceCurve, brute_force

TYPES = np.array([*CLASS_NAMES, "Van", "Person_sitting", "Truck"])
SHARES = (0.70, 0.11, 0.04, 0.08, 0.01, 0.06)
SIZES_HWL_M = np.array(
    [[1.53, 1.63, 3.88], [1.76, 0.66, 0.84], [1.74, 0.6, 1.76], [2.2, 1.9, 5.1], [1.3, 0.6, 0.8], [3.3, 2.6, 10.1]]
)
FOCAL_PX, CENTER_PX, CAMERA_HEIGHT_M = 721.5, np.array([609.6, 172.9]), 1.65


def main(
    frames: Annotated[int, typer.Option(help="Frames to evaluate.")] = 3769,
    detections: Annotated[int, typer.Option(help="Detections in each frame.")] = 100,
    bands: Annotated[int, typer.Option(help="Distance bands of 20 m to evaluate besides.")] = 0,
    reference_frames: Annotated[int, typer.Option(help="Frames for the brute-force reference.")] = 20,
    seed: Annotated[int, typer.Option(help="Seed of the made-up frames.")] = 0,
) -> None:
    """Print time, memory and the comparison."""
    console = Console()
    rng = np.random.default_rng(seed)
    truth, found = zip(*(_frame(rng, number, detections) for number in range(frames)), strict=True)
    objects = sum(map(len, truth))
    console.print(f"{frames} frames, {objects} objects and areas, {sum(map(len, found))} detections, seed {seed}")

    before_mib = peak_memory_mib() or math.nan
    start = time.perf_counter()
    edges = 20.0 * np.arange(bands + 1)
    results = evaluate(truth, found, CLASS_NAMES, bands_m=list(pairwise(edges)))
    wall_s = time.perf_counter() - start
    peak_mib = peak_memory_mib() or math.nan
    console.print(f"evaluation: {wall_s:.1f} s; peak memory {peak_mib:.0f} MiB, {before_mib:.0f} MiB of it before")
    for name in CLASS_NAMES:
        values = [f"{results.overall.curves[name, '3d', difficulty].r40:.2f}" for difficulty in DIFFICULTIES]
        console.print(f"  {name}: 3D AP R40 {' / '.join(values)}")

    few_truth, few_found = list(truth[:reference_frames]), list(found[:reference_frames])
    start = time.perf_counter()
    few = evaluate(few_truth, few_found, CLASS_NAMES).overall
    fast_s = time.perf_counter() - start
    start = time.perf_counter()
    references = brute_force(few_truth, few_found, CLASS_NAMES)
    slow_s = time.perf_counter() - start
    _check(few, references)
    console.print(
        f"{reference_frames} frames: reference {slow_s:.1f} s, ours {fast_s:.2f} s, "
        f"{slow_s / fast_s:.0f} times as fast; all {len(references)} curves agree"
    )


def _frame(rng: np.random.Generator, number: int, detections: int) -> tuple[FrameObjects, FrameObjects]:
    """Return ground truth and detections of one frame."""
    objects = 1 + rng.poisson(6)
    kinds = rng.choice(len(TYPES), objects, p=SHARES)
    boxes = _boxes(rng, kinds)
    areas = rng.poisson(2.5)
    corners = rng.uniform([0, 150], [1200, 190], (areas, 2))
    truth = _objects(
        number,
        (*TYPES[kinds], *["DontCare"] * areas),
        np.concatenate([boxes, np.tile([-1, -1, -1, -1000, -1000, -1000, -10], (areas, 1))]),
        np.concatenate([_image_boxes(boxes), np.hstack([corners, corners + rng.uniform(8, 60, (areas, 2))])]),
        truncated=np.concatenate([rng.choice([0.0, 0.15, 0.4], objects, p=[0.85, 0.1, 0.05]), -np.ones(areas)]),
        occluded=np.concatenate([rng.choice(4, objects, p=[0.5, 0.25, 0.2, 0.05]).astype(float), -np.ones(areas)]),
    )
    others = rng.choice(3, detections, p=[0.6, 0.25, 0.15])
    model = rng.integers(-objects, objects * 2, detections)
    near = (model >= 0) & (model < objects)
    source = np.where(near, model, 0)
    # Detections have the model's class if it is among the classes, otherwise that of a car.
    others[near] = np.where(kinds[source] < 3, kinds[source], 0)[near]
    reported = _boxes(rng, others)
    noise = rng.normal(0, [0.05, 0.05, 0.15, 0.15, 0.05, 0.2, 0.1], (detections, 7))
    reported[near] = (boxes[source] + noise)[near]
    scores = np.where(near, rng.beta(4, 2, detections), rng.beta(2, 5, detections))
    unknown = -np.ones(detections)
    found = _objects(number, tuple(TYPES[others]), reported, _image_boxes(reported), unknown, unknown, scores)
    return truth, found


def _boxes(rng: np.random.Generator, kinds: NDArray[np.int64]) -> NDArray[np.float64]:
    """Return height, width, length, x, y, z and rotation_y (N, 7) of synthetic objects in front of the camera."""
    count = len(kinds)
    z_m = rng.uniform(5, 70, count)
    x_m = rng.uniform(-0.7, 0.7, count) * z_m
    places = [x_m, CAMERA_HEIGHT_M + rng.normal(0, 0.1, count), z_m, rng.uniform(-np.pi, np.pi, count)]
    return np.column_stack([SIZES_HWL_M[kinds] * rng.uniform(0.9, 1.1, (count, 3)), *places])


def _image_boxes(boxes: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return image boxes of boxes (N, 7), approximated by upright rectangles facing the camera: (N, 4) pixels."""
    height_m, width_m, length_m, x_m, y_m, z_m, rotation_y = boxes.T
    half_m = (np.abs(np.cos(rotation_y)) * length_m + np.abs(np.sin(rotation_y)) * width_m) / 2
    depth_m = np.maximum(z_m, 1.0)
    corners = np.stack([x_m - half_m, y_m - height_m, x_m + half_m, y_m]) / depth_m
    return np.clip(FOCAL_PX * corners.T + np.tile(CENTER_PX, 2), 0, [1241, 374, 1241, 374])


def _objects(
    number: int,
    types: tuple[str, ...],
    boxes: NDArray[np.float64],
    image_boxes: NDArray[np.float64],
    truncated: NDArray[np.float64],
    occluded: NDArray[np.float64],
    scores: NDArray[np.float64] | None = None,
) -> FrameObjects:
    return FrameObjects(
        frame_id=f"{number:06d}",
        types=types,
        bbox=image_boxes,
        alpha=boxes[:, 6] - np.arctan2(boxes[:, 3], boxes[:, 5]),
        dimensions_hwl=boxes[:, :3],
        locations=boxes[:, 3:6],
        rotation_y=boxes[:, 6],
        truncated=truncated,
        occluded=occluded,
        scores=np.zeros(len(types)) if scores is None else scores,
    )


def _check(results: KittiResults, references: dict[tuple[str, str, str], ReferenceCurve]) -> None:
    if results.curves.keys() != references.keys():
        raise SystemExit("the reference evaluates other curves")
    for key, reference in references.items():
        ours = results.curves[key]
        for field in (f.name for f in fields(ours) if f.name in ReferenceCurve._fields):
            if not np.allclose(getattr(ours, field), getattr(reference, field), rtol=0, atol=1e-9):
                raise SystemExit(f"the reference has other {field} of {' '.join(key)}")


if __name__ == "__main__":
    run_command(main)
