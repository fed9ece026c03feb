"""Writing simulated frames in KITTI's layout, in several processes, into a folder that records its settings."""

import json
import tempfile
from collections.abc import Callable, Iterable, Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any, Literal, TypeVar

import numpy as np
import numpy.typing as npt

from asca_pillars.base.errors import ConfigError, DatasetError
from asca_pillars.base.files import write_text
from asca_pillars.base.own_files import json_object, require_no_link, require_own, require_own_file
from asca_pillars.base.processes import map_in_processes
from asca_pillars.base.progress import Reporter
from asca_pillars.base.schema import parse
from asca_pillars.base.settings import read_settings, shipped_configs
from asca_pillars.base.strict import Strict
from asca_pillars.cluster import run_items
from asca_pillars.data.kitti import (
    Calibration,
    KittiObject,
    KittiSplit,
    in_image,
    write_calibration,
    write_image_set,
    write_labels,
)
from asca_pillars.data.kitti.calibration import DEFAULT_IMAGE_SIZE_WH
from asca_pillars.data.kitti.kitti_split import SIMULATION_FILE
from asca_pillars.scans.scan_reader import write_scan
from asca_pillars.sim.annotation import label_all_around, label_camera_view
from asca_pillars.sim.casting.raycast import Hits, cast
from asca_pillars.sim.lidar import Firings, Lidar, draw_firings
from asca_pillars.sim.returns import Returns, measure
from asca_pillars.sim.scene_config import SceneConfig
from asca_pillars.sim.world.scene import Scene, build, draw_scene
from asca_pillars.sim.world.streets import draws_of

COMMAND = "asca simulate"
Item = TypeVar("Item")


def check_counts(counts: dict[str, int], val_share: float) -> None:
    """Raise ConfigError for a count below 1 or a share outside 0..1."""
    for name, count in counts.items():
        if count < 1:
            raise ConfigError(f"{name} is {count}; it must be at least 1")
    if not 0.0 <= val_share <= 1.0:
        raise ConfigError(f"val_share is {val_share}; it must lie between 0 and 1")


def held_out(count: int, share: float) -> int:
    """Return the number of frames or sequences for validation: at least one, if one remains for training."""
    rounded = round(count * share)
    return min(max(rounded, 1), count - 1) if 0 < share < 1 and count > 1 else rounded


def for_each(job: Callable[[Item], None], todo: Sequence[Item], workers: int, reporter: Reporter) -> None:
    """Do a job for each item, in `workers` processes; the job must be picklable."""
    for _ in map_in_processes(job, todo, workers, "Simulating", reporter=reporter):
        pass


def require_own_simulation(root: Path, about_keys: Sequence[str], folders: Iterable[str | Path]) -> None:
    """Make sure that `asca simulate` may write into `root`: it is absent, empty, or holds an earlier simulation.

    Args:
        root: the folder.
        about_keys: keys of its simulation.json.
        folders: folders below `root` for the frames.

    Raises:
        OutputError: something else is there, such as a list that was edited, or a link.
    """
    require_own(root, COMMAND, {SIMULATION_FILE: json_object(*about_keys)}, folders=("ImageSets", *folders))
    for name in ("train", "val"):
        require_own_file(root / "ImageSets" / f"{name}.txt", COMMAND, _names_successive_frames)


def write_once(path: Path, write: Callable[[Path], None]) -> None:
    """Write a file of a frame with `write`. One with the same bytes, of a run that was killed, stays.

    Raises:
        OutputError: a file of other bytes is there.
    """
    require_no_link(path)
    if not path.exists() or not path.stat().st_size:
        write(path)
        return
    with tempfile.TemporaryDirectory() as folder:
        write(Path(folder) / path.name)
        require_own_file(path, COMMAND, lambda existing: existing.read_bytes() == Path(folder, path.name).read_bytes())


def record_settings(root: Path, about: dict[str, Any], scans: Path) -> None:
    """Write the settings of the frames of a folder to simulation.json, or refuse a folder of other frames.

    Args:
        root: the folder.
        about: the settings, plain values.
        scans: folder below it that holds the scans.

    Raises:
        DatasetError: the scans there have other settings.
    """
    path = root / SIMULATION_FILE
    text = json.dumps(about, indent=2) + "\n"
    if not path.exists():
        if any(scans.rglob("*.bin")):
            raise DatasetError(f"{scans}: holds scans that were not simulated; choose another folder")
        write_text(path, text)
    elif path.read_text(encoding="utf-8") != text:
        raise DatasetError(f"{path}: the frames there have another seed or configuration; choose another folder")


def _names_successive_frames(path: Path) -> bool:
    """Return whether a list is one that is written here, of frames (000007) or of sequences (0002/000031)."""
    try:
        lines = path.read_text(encoding="utf-8").splitlines()
        rows = [[int(part) for part in line.split("/")] for line in lines]
    except ValueError:
        return False
    length = 1 + max(sum(row[1:]) for row in rows)
    numbers = [row[0] * length + sum(row[1:]) for row in rows]
    return numbers == list(range(numbers[0], numbers[0] + len(numbers)))


MARGIN_PX = 3.0  # points are rounded to millimetres


def outside_image(firings: Firings, calib: Calibration) -> npt.NDArray[np.bool_]:
    """Return (K,C) firings all of whose returns are beyond one border of the image, or behind the camera.

    The space beyond a border is a half space (x, y, z, 1) * plane > 0, so that a ray is in it if it is at the
    nearest and at the farthest range.
    """
    u, v, depth = calib.p2 @ calib.rect_from_lidar_matrix
    width, height = DEFAULT_IMAGE_SIZE_WH
    planes = (
        -u - MARGIN_PX * depth,
        u - (width + MARGIN_PX) * depth,
        -v - MARGIN_PX * depth,
        v - (height + MARGIN_PX) * depth,
    )
    stretch = np.sqrt(1.0 + firings.slope**2)
    ends_m = np.array(firings.lidar.range_m)[:, None] / stretch  # (2,K) horizontal distances
    cos, sin = np.cos(firings.azimuth_rad), np.sin(firings.azimuth_rad)
    phase = np.stack([np.cos(firings.phase_rad), np.sin(firings.phase_rad)], axis=1)
    outside = np.zeros((len(firings.slope), len(cos)), bool)
    for x, y, z, offset in planes:
        # Along a ray the product is start + rise * distance: positive at both ends if the rise exceeds -start / each.
        start, rise = z * firings.origin_z_m + offset, phase @ np.stack([x * cos + y * sin, y * cos - x * sin])
        least = (-start / ends_m).max(axis=0) - z * firings.slope
        outside |= rise > least[:, None]
    return outside


_SHARD_FRAMES = 20  # of a cluster's worker: a second or two


@dataclass(frozen=True)
class SimulationConfig(Strict):
    """Settings of a simulation.

    Attributes:
        field_of_view: "full" is a whole revolution like KITTI's files, in which only the camera's view is labelled;
            "camera" keeps only that part, casts a quarter of the rays and gives the same labels and the same points
            there; "around" is the revolution of "full" with labels in every direction (see `annotation`).
    """

    scene: SceneConfig = field(default_factory=SceneConfig)
    lidar: Lidar = field(default_factory=Lidar)
    field_of_view: Literal["full", "camera", "around"] = "full"


@dataclass(frozen=True)
class Frame:
    """Labelled scan: points (N,4) float32 x, y, z metres in the LiDAR frame and reflectance 0..1."""

    points: npt.NDArray[np.float32]
    objects: list[KittiObject]
    calibration: Calibration


RAY_KEYS = 1 << 62
"""Upper bound of the random keys of a scan's rays, which fit an int64."""
_BEYOND_THE_IMAGE_DEG = 1.0  # firings end at the image; objects across its border are complete


def built_half_angle_rad(config: SimulationConfig) -> float:
    """Return the angle to each side of straight ahead within which bodies are built."""
    if config.field_of_view != "camera":
        return np.pi
    return float(np.deg2rad(config.lidar.camera_half_angle_deg + _BEYOND_THE_IMAGE_DEG))


def simulate_frame(seed: int, index: int, config: SimulationConfig | None = None) -> Frame:
    """Simulate frame `index` of the data set `seed`: the same for every call, whatever other frames are simulated."""
    config = config or SimulationConfig()
    camera_only, around = config.field_of_view == "camera", config.field_of_view == "around"
    scene = draw_scene(config.scene, draws_of(seed, index, 0))
    firings = draw_firings(config.lidar, draws_of(seed, index, 2), camera_only, around)
    hits, returns = take_scan(scene, config, firings, (seed, index), draws_of(seed, index, 3))
    seen = np.ones(len(returns.points), bool) if around else in_image(returns.points, scene.calibration)
    label = label_all_around if around else label_camera_view
    objects = label(scene.targets, hits, returns.owner[seen], scene.calibration, config.scene)
    points = returns.points[seen] if camera_only else returns.points
    return Frame(np.ascontiguousarray(points), objects, scene.calibration)


def take_scan(
    scene: Scene,
    config: SimulationConfig,
    firings: Firings,
    seed: tuple[int, ...],
    noise: np.random.Generator,
    numbers: Sequence[int] | None = None,
) -> tuple[Hits, Returns]:
    """Scan a scene: return the hit of each firing, and the points (N, 4) of the sensor.

    Args:
        scene: scene in the LiDAR frame.
        config: settings of the scene and the sensor.
        firings: firings of this scan.
        seed: seed of the bodies, and `numbers` of each, as for `world.scene.build`.
        noise: generator of this scan.
        numbers: numbers of the bodies.
    """
    camera_only = config.field_of_view == "camera"
    if camera_only:
        firings = replace(firings, outside=outside_image(firings, scene.calibration))
    bodies = build(scene, config.scene, seed, built_half_angle_rad(config), numbers)
    key = int(noise.integers(RAY_KEYS))
    hits = cast(bodies, len(scene.targets), scene.ground, firings, key)
    return hits, measure(hits, firings, noise)


def simulate(
    out: str | Path,
    frames: int,
    seed: int = 0,
    workers: int = 1,
    config: SimulationConfig | None = None,
    val_share: float = 0.1,
    reporter: Reporter | None = None,
    *,
    cluster: str | None = None,
) -> Path:
    """Write `frames` labelled frames below `out` in KITTI's layout; returns `out`.

    training/{velodyne,label_2,calib}/000000.* and ImageSets/{train,val}.txt; the last `val_share` of the frames is
    for validation. A frame depends on `seed`, `config` and its number alone: any number of workers writes the same
    bytes. A run that was interrupted, or asked for fewer frames, is resumed; simulation.json in the
    folder tells what it holds.

    Args:
        out: the folder; with a cluster, one that every machine mounts at the same place.
        frames: number of frames.
        seed: seed of the whole data set.
        workers: processes, without a cluster.
        config: settings of the simulation.
        val_share: 0..1.
        reporter: for the progress, and told which cluster it is; None for none.
        cluster: address of a Ray cluster that does the work, `local` for one on this machine; None: processes.

    Raises:
        ClusterError: the cluster cannot be used, or a frame ended each process that worked on it.
        ConfigError: a number of frames or workers below 1, or a share outside 0..1.
        DatasetError: `out` holds frames of another seed or configuration.
    """
    check_counts({"frames": frames, "workers": workers}, val_share)
    root, reporter = Path(out), reporter or Reporter()
    config = config or SimulationConfig()
    split = KittiSplit(root)
    record_settings(root, {"seed": seed, **asdict(config)}, split.folder / "velodyne")
    todo = [index for index in range(frames) if not _is_complete(split, index)]
    job = partial(_write_frame, root.absolute(), seed, config)
    if cluster is not None:
        run_items(
            job,
            todo,
            cluster,
            shard_size=_SHARD_FRAMES,
            seen=root / SIMULATION_FILE,
            folders=[split.folder / name for name in ("velodyne", "label_2", "calib")],
            title="Simulating",
            reporter=reporter,
        )
    else:
        for_each(job, todo, workers, reporter)
    names = [frame_id(index) for index in range(frames)]
    first_val = frames - held_out(frames, val_share)
    write_image_set(root, "train", names[:first_val])
    write_image_set(root, "val", names[first_val:])
    return root


def require_own_frames(out: Path) -> None:
    """Make sure that `simulate` may write into `out`; OutputError names foreign files."""
    folders = [f"training/{name}" for name in ("velodyne", "label_2", "calib")]
    require_own_simulation(out, ("seed", "scene", "lidar", "field_of_view"), folders)


def frame_id(index: int) -> str:
    """Return KITTI's name of a frame: six digits."""
    return f"{index:06d}"


def _is_complete(split: KittiSplit, index: int) -> bool:
    """Return whether a frame is complete: its scan is written last."""
    return split.scan_path(frame_id(index)).exists()


def _write_frame(root: Path, seed: int, config: SimulationConfig, index: int) -> None:
    split, name = KittiSplit(root), frame_id(index)
    frame = simulate_frame(seed, index, config)
    write_once(split.calib_path(name), lambda path: write_calibration(path, frame.calibration))
    write_once(split.label_path(name), lambda path: write_labels(path, frame.objects))
    write_scan(split.scan_path(name), frame.points)


KIND = "simulation"


def load_simulation_config(path: str | None, view: str | None = None) -> SimulationConfig:
    """Read a YAML file with `scene`, `lidar` and `field_of_view`, each with its differences from the defaults.

    Args:
        path: the file, or the name of one in configs/simulation/; None for the defaults, which imitate KITTI.
        view: "full", "camera" or "around", which wins over the file.

    Raises:
        ConfigError: unreadable YAML, an unknown key anywhere (the nearest is named), an impossible value.
    """
    config = SimulationConfig() if path is None else read_settings(SimulationConfig, path, (), shipped_configs(KIND))
    if view is None:
        return config
    return replace(config, field_of_view=parse(SimulationConfig, {"field_of_view": view}, "--view").field_of_view)
