"""Writing simulated frames in KITTI's layout."""

import contextlib
import json
import multiprocessing
import os
from collections.abc import Iterable, Iterator
from dataclasses import asdict, dataclass, field
from functools import partial
from pathlib import Path
from typing import Literal

import numpy as np
import numpy.typing as npt
from rich.progress import track

from asca_pillars.cluster.run_shards import run_each
from asca_pillars.data.kitti import (
    Calibration,
    KittiObject,
    KittiSplit,
    in_image,
    write_calibration,
    write_image_set,
    write_labels,
)
from asca_pillars.errors import ConfigError, DatasetError
from asca_pillars.files import atomic_path
from asca_pillars.sim.annotation import label_all_around, label_camera_view
from asca_pillars.sim.casting.raycast import cast
from asca_pillars.sim.scene_config import SceneConfig
from asca_pillars.sim.sensor.lidar import Lidar, draw_firings
from asca_pillars.sim.sensor.returns import measure
from asca_pillars.sim.world.scene import build, draw_scene

_ABOUT = "simulation.json"
_SHARD_FRAMES = 20  # of a cluster's worker: a second or two


@dataclass(frozen=True)
class SimulationConfig:
    """What to simulate.

    Attributes:
        field_of_view: "full" is a whole revolution like KITTI's files, of which only what the camera sees is labelled;
            "camera" keeps only that part, casts a quarter of the rays and gives the same labels and the same points
            there; "around" is the revolution of "full" with labels in every direction (see `annotation`).
    """

    scene: SceneConfig = field(default_factory=SceneConfig)
    lidar: Lidar = field(default_factory=Lidar)
    field_of_view: Literal["full", "camera", "around"] = "full"

    __pydantic_config__ = {"extra": "forbid", "allow_inf_nan": False}  # noqa: RUF012 - a class constant that pydantic reads


@dataclass(frozen=True)
class Frame:
    """One labelled scan: points (N,4) float32 x, y, z metres in the LiDAR frame and reflectance 0..1."""

    points: npt.NDArray[np.float32]
    objects: list[KittiObject]
    calibration: Calibration


def simulate_frame(seed: int, index: int, config: SimulationConfig | None = None) -> Frame:
    """Frame `index` of the data set `seed`: the same for every call, whatever other frames are made."""
    config = config or SimulationConfig()
    camera_only, around = config.field_of_view == "camera", config.field_of_view == "around"
    scene = draw_scene(config.scene, np.random.default_rng([seed, index, 0]))
    firings = draw_firings(config.lidar, np.random.default_rng([seed, index, 2]), camera_only, around)
    half_angle = np.deg2rad(config.lidar.camera_half_angle_deg + 1.0)
    bodies = build(scene, config.scene, (seed, index), half_angle if camera_only else np.pi)
    noise = np.random.default_rng([seed, index, 3])
    key = int(noise.integers(1 << 62))
    hits = cast(bodies, len(scene.targets), scene.ground, firings, key)
    returns = measure(hits, firings, noise)
    seen = np.ones(len(returns.points), bool) if around else in_image(returns.points, scene.calibration)
    label = label_all_around if around else label_camera_view
    objects = label(scene.targets, hits, returns.owner[seen], scene.calibration, config.scene)
    points = returns.points[seen] if camera_only else returns.points
    return Frame(np.ascontiguousarray(points), objects, scene.calibration)


def simulate(
    out: str | Path,
    frames: int,
    seed: int = 0,
    workers: int = 1,
    config: SimulationConfig | None = None,
    val_share: float = 0.1,
    progress: bool = True,
    *,
    cluster: str | None = None,
) -> Path:
    """Write `frames` labelled frames below `out` in KITTI's layout; returns `out`.

    training/{velodyne,label_2,calib}/000000.* and ImageSets/{train,val}.txt; the last `val_share` of the frames is
    for validation. A frame depends on `seed`, `config` and its number alone: any number of workers writes the same
    bytes. A run that was interrupted, or asked for fewer frames, goes on where it stopped; simulation.json in the
    folder tells what it holds.

    Args:
        out: the folder; with a cluster, one that every machine mounts at the same place.
        frames: how many.
        seed: of the whole data set.
        workers: processes, without a cluster.
        config: what to simulate.
        val_share: 0..1.
        progress: whether it is shown.
        cluster: address of a Ray cluster that does the work, `local` for one on this machine; None: processes.

    Raises:
        ClusterError: the cluster cannot be used, or a frame ended each process that worked on it.
        ConfigError: a number of frames or workers below 1, or a share outside 0..1.
        DatasetError: `out` holds frames of another seed or configuration.
    """
    if frames < 1 or workers < 1:
        raise ConfigError(f"frames is {frames} and workers is {workers}; both must be at least 1")
    if not 0.0 <= val_share <= 1.0:
        raise ConfigError(f"val_share is {val_share}; it must lie between 0 and 1")
    root = Path(out)
    config = config or SimulationConfig()
    _claim_folder(root, seed, config)
    split = KittiSplit(root)
    todo = [index for index in range(frames) if not _is_complete(split, index)]
    job = partial(_write_frame, root.absolute(), seed, config)
    if cluster is not None:
        run_each(
            job,
            todo,
            cluster,
            shard_size=_SHARD_FRAMES,
            seen=root / _ABOUT,
            folders=[split.folder / name for name in ("velodyne", "label_2", "calib")],
            title="Simulating",
            progress=progress,
        )
    elif workers > 1 and len(todo) > 1:
        # Fork would copy the threads of whatever library runs here; a fresh interpreter per worker cannot hang.
        with (
            _one_thread_per_process(),
            multiprocessing.get_context("spawn").Pool(min(workers, len(todo))) as pool,
        ):
            _watch(pool.imap_unordered(job, todo, chunksize=4), len(todo), progress)
    else:
        _watch(map(job, todo), len(todo), progress)
    names = [frame_id(index) for index in range(frames)]
    first_val = frames - round(frames * val_share)
    write_image_set(root, "train", names[:first_val])
    write_image_set(root, "val", names[first_val:])
    return root


def frame_id(index: int) -> str:
    """KITTI's name of a frame: six digits."""
    return f"{index:06d}"


def _claim_folder(root: Path, seed: int, config: SimulationConfig) -> None:
    """Note in simulation.json what the frames of a folder depend on; refuse a folder of other frames."""
    path = root / _ABOUT
    text = json.dumps({"seed": seed, **asdict(config)}, indent=2) + "\n"
    if not path.exists():
        scans = KittiSplit(root).folder / "velodyne"
        if any(scans.glob("*.bin")):
            raise DatasetError(f"{scans}: holds scans that were not simulated; choose another folder")
        with atomic_path(path) as temporary:
            temporary.write_text(text, encoding="utf-8")
    elif path.read_text(encoding="utf-8") != text:
        raise DatasetError(f"{path}: the frames there have another seed or configuration; choose another folder")


@contextlib.contextmanager
def _one_thread_per_process() -> Iterator[None]:
    """Linear algebra of the processes started inside uses one thread each: the processes are the parallelism."""
    before = os.environ.get("OPENBLAS_NUM_THREADS")
    os.environ["OPENBLAS_NUM_THREADS"] = "1"
    try:
        yield
    finally:
        if before is None:
            del os.environ["OPENBLAS_NUM_THREADS"]
        else:
            os.environ["OPENBLAS_NUM_THREADS"] = before


def _watch(results: Iterable[None], total: int, progress: bool) -> None:
    for _ in track(results, "Simulating", total=total, disable=not progress):
        pass


def _is_complete(split: KittiSplit, index: int) -> bool:
    """The scan is written last: where it is, the frame is complete."""
    return split.scan_path(frame_id(index)).exists()


def _write_frame(root: Path, seed: int, config: SimulationConfig, index: int) -> None:
    split, name = KittiSplit(root), frame_id(index)
    frame = simulate_frame(seed, index, config)
    write_calibration(split.calib_path(name), frame.calibration)
    write_labels(split.label_path(name), frame.objects)
    with atomic_path(split.scan_path(name)) as temporary:
        frame.points.tofile(temporary)
