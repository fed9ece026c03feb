"""Where RS-Aug and GT-Aug put objects: measured against what the simulator knows, checked with shapely, drawn, timed.

    asca simulate data/aug --frames 400 --seed 1 --view camera
    python benchmarks/rs_aug.py data/aug --picture rs_aug.png

Of each inserted object:

- *stands*: its bottom is within 0.2 m of the true ground under its middle; under the whole footprint the ground is
  carriageway (crossing road, markings and rails included) or pavement, or it is flat, with a slope below 5 degrees; and
  between 0.3 m above the ground and the object's top no body is in its footprint, neither of the background nor of
  another object, labelled or not. Only simulated data knows: a folder without simulation.json has no such row.
- *box*, *cluster*, *insert*: its footprint shares more than a square millimetre with a labelled object, with the
  minimum rectangle of a cluster, or with another inserted object.
- *obstacle point*: a point of the frame lies inside its box, at least 0.3 m above the fitted ground.

Counts are of objects within the grid that are no IGNORED; milliseconds are those of `insert_objects`, maps from disk.
"""

import itertools
import json
import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any

import cv2
import numpy as np
import typer
from numpy.typing import NDArray
from rich.console import Console
from rich.progress import track
from rich.table import Table
from shapely.geometry import MultiPoint, Polygon

from asca_pillars.base.schema import parse
from asca_pillars.cli.run_command import run_command
from asca_pillars.config.tree import Config, InsertMethod, load_config
from asca_pillars.data.frames import LabeledFrame, read_frame
from asca_pillars.data.insertion.free_space import FreeSpace
from asca_pillars.data.insertion.insert_objects import Inserter, insert_objects, prepare_inserter
from asca_pillars.data.kitti import KittiSplit, boxes_from_objects, objects_3d
from asca_pillars.geometry.boxes import footprints, points_in_boxes
from asca_pillars.pictures.drawing import BACKGROUND, BoxLayer
from asca_pillars.pictures.visualize import class_color, draw_layers, write_png

METHODS: dict[InsertMethod, str] = {"gt_aug": "GT-Aug", "rs_aug": "RS-Aug"}
MAX_HEIGHT_ERROR_M = 0.2
MAX_SLOPE = np.tan(np.radians(5.0))
BODY_ABOVE_M = 0.3
SHARED_M2 = 1e-6


@dataclass
class Tally:
    """What was counted of one method."""

    inserted: int = 0
    stands: int = 0
    height_error: int = 0
    not_flat: int = 0
    in_body: int = 0
    boxes: int = 0
    clusters: int = 0
    inserts: int = 0
    obstacle_points: int = 0


def main(
    data: Annotated[Path, typer.Argument(help="KITTI-layout folder.")],
    frames: Annotated[str, typer.Option(help="A list of ImageSets/, or `training` for every frame.")] = "train",
    limit: Annotated[int, typer.Option(help="Frames that are augmented; the database holds the whole list.")] = 200,
    config: Annotated[str, typer.Option(help="YAML, or the name of one that ships.")] = "asca_small_sim",
    prepared: Annotated[Path | None, typer.Option(help="Folder for maps and database. Default: in DATA.")] = None,
    picture: Annotated[Path | None, typer.Option(help="PNG: original, GT-Aug and RS-Aug side by side.")] = None,
    picture_frame: Annotated[str | None, typer.Option(help="Frame of the picture. Default: the first.")] = None,
) -> None:
    """Print both methods side by side."""
    overrides = [f"data.train_set={frames}"] + ([f"data.prepared={prepared}"] if prepared else [])
    settings = load_config(config, overrides)
    split = KittiSplit(data, frames)
    truths = _truths(data)
    console = Console()
    counts: dict[InsertMethod, NDArray[np.int64]] = {}
    tallies: dict[InsertMethod, Tally] = {}
    milliseconds: dict[InsertMethod, list[float]] = {}
    for method, title in METHODS.items():
        inserter = _inserter(split, settings, method)
        tallies[method], milliseconds[method] = Tally(), []
        counts[method] = np.zeros((2, len(settings.model.spec.classes)), np.int64)
        for number, frame_id in enumerate(track(split.frame_ids[:limit], title, console=console)):
            frame = _read(split, frame_id, settings)
            space = inserter.free_space(frame_id)
            start = time.perf_counter()
            augmented = insert_objects(frame, inserter, np.random.default_rng((0, 0, number, 1)))
            milliseconds[method].append(1e3 * (time.perf_counter() - start))
            counts[method] += [_class_counts(one, settings) for one in (frame, augmented)]
            labeled = boxes_from_objects(objects_3d(split.objects(frame_id)), split.calibration(frame_id))
            _check(tallies[method], frame, augmented.boxes[len(frame.boxes) :], labeled, space)
            if truths is not None:
                _stand(tallies[method], augmented.boxes[len(frame.boxes) :], truths, int(frame_id))
    console.print(_placement_table(tallies, milliseconds, truths is not None))
    console.print(_balance_table(counts, settings, len(split.frame_ids[:limit])))
    if picture is not None:
        _draw(picture, split, settings, picture_frame or split.frame_ids[0])


def _inserter(split: KittiSplit, settings: Config, method: InsertMethod) -> Inserter:
    insert = replace(settings.augment.insert, method=method)
    return prepare_inserter(split, settings.model.spec, settings.data, insert)


def _read(split: KittiSplit, frame_id: str, settings: Config) -> LabeledFrame:
    data = settings.data
    names = settings.model.spec.class_names
    return read_frame(split, frame_id, names, camera_view=data.camera_view, min_points=data.min_points)


def _class_counts(frame: LabeledFrame, settings: Config) -> NDArray[np.int64]:
    counted = (frame.labels >= 0) & settings.model.spec.ranges.hold_centers(frame.boxes)
    return np.bincount(frame.labels[counted], minlength=len(settings.model.spec.classes))


def _check(
    tally: Tally, frame: LabeledFrame, inserted: NDArray[np.float32], labeled: NDArray[np.float32], space: FreeSpace
) -> None:
    """Count intersections, with shapely's polygons instead of our own geometry."""
    tally.inserted += len(inserted)
    own, boxes, clusters = (_polygons(some) for some in (inserted, labeled, space.clusters))
    tally.boxes += sum(any(a.intersection(b).area > SHARED_M2 for b in boxes) for a in own)
    tally.clusters += sum(any(a.intersection(b).area > SHARED_M2 for b in clusters) for a in own)
    pairs = itertools.combinations(own, 2)
    tally.inserts += sum(a.intersection(b).area > SHARED_M2 for a, b in pairs)
    if space.ground is not None:
        xyz = frame.points[:, :3].astype(float)
        high = xyz[:, 2] - space.ground.heights(xyz[:, :2]) >= BODY_ABOVE_M
        tally.obstacle_points += int(points_in_boxes(xyz[high], inserted).any(axis=0).sum())


def _polygons(boxes: NDArray[np.floating]) -> list[Polygon]:
    return [Polygon(outline) for outline in footprints(boxes.astype(float))]


def _truths(data: Path) -> tuple[int, Any] | None:
    """Seed and scene configuration of simulated data, or None for any other."""
    path = data / "simulation.json"
    if not path.exists():
        return None
    from asca_pillars.sim.simulation import SimulationConfig

    found = json.loads(path.read_text(encoding="utf-8"))
    return found.pop("seed"), parse(SimulationConfig, found, str(path)).scene


def _stand(tally: Tally, inserted: NDArray[np.float32], truths: tuple[int, Any], index: int) -> None:
    """Count which of the objects stand on true ground, see the top of the file."""
    from asca_pillars.sim.world.scene import draw_scene

    seed, config = truths
    scene = draw_scene(config, np.random.default_rng([seed, index, 0]))
    bodies = np.array([target.box for target in scene.targets]).reshape(-1, 7)
    for box in inserted.astype(np.float64):
        bottom = box[2] - box[5] / 2
        error = abs(bottom - scene.ground.heights(box[None, :2])[0]) > MAX_HEIGHT_ERROR_M
        uneven = not _is_street_or_flat(box, scene.ground)
        inside = _meets_background(box, scene) or _meets_boxes(box, bodies)
        tally.height_error += error
        tally.not_flat += uneven
        tally.in_body += inside
        tally.stands += not (error or uneven or inside)


def _is_street_or_flat(box: NDArray[np.float64], ground: Any) -> bool:
    from asca_pillars.sim.casting.groundcast import VERGE, ground_material

    xy = _spread(box)
    verge = np.array([ground_material(x, y, ground.street) == VERGE for x, y in xy])
    step = 0.25
    slopes = [
        (ground.heights(xy + shift) - ground.heights(xy - shift)) / (2 * step) for shift in ((step, 0.0), (0.0, step))
    ]
    return not (verge & (np.hypot(*slopes) > MAX_SLOPE)).any()


def _meets_boxes(box: NDArray[np.float64], others: NDArray[np.float64]) -> bool:
    outline = _polygons(box[None])[0]
    return any(outline.intersection(other).area > SHARED_M2 for other in _polygons(others))


def _meets_background(box: NDArray[np.float64], scene: Any) -> bool:
    """Whether a house, wall, post, shrub ... reaches into the box above BODY_ABOVE_M."""
    low, high = box[2] - box[5] / 2 + BODY_ABOVE_M, box[2] + box[5] / 2
    outline, bodies = _polygons(box[None])[0], scene.background
    reach = np.hypot(box[3], box[4]) / 2
    triangles = bodies.triangles
    first, last = triangles.min(axis=1), triangles.max(axis=1)
    near = ((first[:, :2] < box[:2] + reach) & (last[:, :2] > box[:2] - reach)).all(axis=1)
    near &= (first[:, 2] < high) & (last[:, 2] > low)
    if any(MultiPoint(triangle[:, :2]).convex_hull.intersects(outline) for triangle in triangles[near]):
        return True
    xy = _spread(box)
    inside = np.concatenate([np.column_stack([xy, np.full(len(xy), z)]) for z in np.arange(low, high, 0.2)])
    away = inside[:, None] - bodies.centers[None]
    unit = np.einsum("eij,pej->pei", bodies.unit_from_world, away)
    return bool((np.square(unit).sum(axis=2) < 1).any())


def _spread(box: NDArray[np.float64], step_m: float = 0.2) -> NDArray[np.float64]:
    """Points (P, 2) all over a footprint."""
    along, across = (np.linspace(-size / 2, size / 2, int(size / step_m) + 2) for size in box[3:5])
    u, v = (part.ravel() for part in np.meshgrid(along, across))
    cos, sin = np.cos(box[6]), np.sin(box[6])
    return np.column_stack([box[0] + cos * u - sin * v, box[1] + sin * u + cos * v])


def _placement_table(
    tallies: dict[InsertMethod, Tally], milliseconds: dict[InsertMethod, list[float]], simulated: bool
) -> Table:
    table = Table(title="Where inserted objects stand")
    table.add_column("")
    for title in METHODS.values():
        table.add_column(title, justify="right")
    both = list(tallies.values())
    table.add_row("inserted", *(str(tally.inserted) for tally in both))
    if simulated:
        shares = (tally.stands / max(tally.inserted, 1) for tally in both)
        table.add_row("stands on road or flat ground", *(f"{share:.1%}" for share in shares))
        for name in ("height_error", "not_flat", "in_body"):
            table.add_row(f"  fails by {name}", *(str(getattr(tally, name)) for tally in both))
    for name in ("boxes", "clusters", "inserts", "obstacle_points"):
        table.add_row(f"meets {name}", *(str(getattr(tally, name)) for tally in both))
    table.add_row("ms per frame, mean", *(f"{np.mean(ms):.1f}" for ms in milliseconds.values()))
    for share in (50, 95):
        table.add_row(f"ms per frame, p{share}", *(f"{np.percentile(ms, share):.1f}" for ms in milliseconds.values()))
    return table


def _balance_table(counts: dict[InsertMethod, NDArray[np.int64]], settings: Config, frames: int) -> Table:
    names = settings.model.spec.class_names
    wanted = np.array([settings.augment.insert.proportions.get(name, 0.0) for name in names])
    if not settings.augment.insert.proportions:
        wanted[:] = 1
    table = Table(title="Objects per frame, and the share of each class over the share wanted")
    for column in ("", *names):
        table.add_column(column, justify="right")
    before = next(iter(counts.values()))[0]
    rows = {"original": before} | {METHODS[method]: count[1] for method, count in counts.items()}
    for title, count in rows.items():
        ratio = (count / count.sum()) / np.where(wanted > 0, wanted / wanted.sum(), np.nan)
        table.add_row(title, *(f"{c / frames:.2f} ({r:.2f})" for c, r in zip(count, ratio, strict=True)))
    return table


def _draw(path: Path, split: KittiSplit, settings: Config, frame_id: str) -> None:
    """As Figure 7 of the paper: the scan, with GT-Aug, with RS-Aug. Original boxes are white."""
    frame = _read(split, frame_id, settings)
    panels = []
    for method in ("none", *METHODS):
        shown = frame
        if method != "none":
            inserter = _inserter(split, settings, method)
            shown = insert_objects(frame, inserter, np.random.default_rng((0, 0, 0, 1)))
        boxes, labels = shown.boxes[len(frame.boxes) :], shown.labels[len(frame.boxes) :]
        layers = [
            BoxLayer(name, boxes[labels == label], class_color(name))
            for label, name in enumerate(settings.model.spec.class_names)
        ]
        layers.append(BoxLayer("labelled", frame.boxes, (255, 255, 255), thickness_px=2))
        panel = draw_layers(shown.points, layers, settings.model.spec.ranges, width_px=700)
        framed = cv2.copyMakeBorder(panel, 40, 0, 0, 8, cv2.BORDER_CONSTANT, value=BACKGROUND)
        title = METHODS.get(method, "Original")
        cv2.putText(framed, title, (16, 30), cv2.FONT_HERSHEY_DUPLEX, 0.8, (255, 255, 255), 1, cv2.LINE_AA)
        panels.append(framed.astype(np.uint8))
    height = max(len(panel) for panel in panels)
    panels = [np.pad(panel, ((0, height - len(panel)), (0, 0), (0, 0))) for panel in panels]
    write_png(path, np.concatenate(panels, axis=1))


if __name__ == "__main__":
    run_command(main)
