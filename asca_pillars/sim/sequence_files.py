"""Simulated sequences as a dataset of boxes in the LiDAR frame (`data.boxes.box_split`), with identities and times.

Below the dataset's root:

    dataset.yaml                    paths of the rest
    scans/0002/000031.bin           scan 31 of sequence 2
    labels/0002/000031.json         its boxes, time and pose: see `frame_labels`
    ImageSets/train.txt, val.txt    whole sequences each
    simulation.json                 the settings of the simulation
"""

from dataclasses import asdict, dataclass, replace
from functools import lru_cache, partial
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import yaml

from asca_pillars.base.files import write_json, write_text
from asca_pillars.base.own_files import require_own_file, starting_with
from asca_pillars.base.progress import SILENT, Reporter
from asca_pillars.data.boxes.box_records import FIELDS
from asca_pillars.data.boxes.box_split import DATASET_FILE
from asca_pillars.data.kitti import in_image, write_image_set
from asca_pillars.scans.scan_reader import write_scan
from asca_pillars.sim.annotation import evidence, nearest_first, occlusion_around
from asca_pillars.sim.lidar import Firings, draw_firings
from asca_pillars.sim.moving_scene import MovingScene, SceneState, draw_moving_scene
from asca_pillars.sim.simulation import (
    COMMAND,
    SimulationConfig,
    check_counts,
    for_each,
    held_out,
    record_settings,
    require_own_simulation,
    take_scan,
    write_once,
)
from asca_pillars.sim.world.streets import draws_of

RATE_HZ = 10.0
_DATASET = yaml.safe_dump({"labels": "labels", "columns": 4, "reflectance_scale": 1.0})
PAUSE_S = 5.0  # from the last scan of a sequence to the first of the next, in the time stamps
# Random streams of a sequence, different from those of single frames.
_SCENE, _WAYS, _SENSOR, _BODIES, _NOISE = 10, 11, 12, 13, 14


@dataclass(frozen=True)
class SequencePlan:
    """Everything that a scan of a sequence depends on, except its number, as in simulation.json."""

    seed: int
    length: int
    config: SimulationConfig

    @property
    def duration_s(self) -> float:
        """Duration of one sequence, seconds."""
        return self.length / RATE_HZ

    def time_s(self, sequence: int, index: int) -> float:
        """Return the time stamp of a scan: sequences follow each other with pauses."""
        return round(sequence * (self.duration_s + PAUSE_S) + index / RATE_HZ, 6)


@dataclass(frozen=True)
class SequenceFrame:
    """Scan of a sequence: points (N, 4) float32 x, y, z metres in the LiDAR frame and reflectance, and labels."""

    points: npt.NDArray[np.float32]
    labels: dict[str, Any]


def simulate_sequence_frame(plan: SequencePlan, sequence: int, index: int) -> SequenceFrame:
    """Simulate scan `index` of a sequence: the same for every call, whatever other scans are simulated."""
    config = plan.config
    world, firings = _world(plan, sequence)
    moment = world.at(index / RATE_HZ)
    noise = draws_of(plan.seed, sequence, _NOISE, index)
    bodies = (plan.seed, sequence, _BODIES)
    hits, returns = take_scan(moment.scene, config, firings, bodies, noise, moment.track_ids)
    points, owner = returns.points, returns.owner
    if config.field_of_view == "camera":
        seen = in_image(points, moment.scene.calibration)
        points, owner = points[seen], owner[seen]
    counts, visible = evidence(hits, owner)
    occluded = [
        occlusion_around(count, share, config.scene) for count, share in zip(counts.tolist(), visible, strict=True)
    ]
    labels = frame_labels(moment, plan.time_s(sequence, index), counts.tolist(), occluded)
    return SequenceFrame(np.ascontiguousarray(points), labels)


def frame_labels(moment: SceneState, time_s: float, points: list[int], occluded: list[int]) -> dict[str, Any]:
    """Return the labels of a scan as plain values: `time_s`, `ego_pose` and `boxes` of all objects with a return.

    A box is a record of `data.boxes.box_records`, LiDAR frame, with `track_id`, `vx_mps` and `vy_mps` (over ground,
    along the frame's axes), `points` and `occluded` (0 to 3, as KITTI's). `ego_pose` is the 4x4 matrix from the LiDAR
    frame to a fixed frame of the sequence, metres.
    """
    boxes = []
    for row in nearest_first(moment.scene.targets).tolist():
        if not points[row]:
            continue
        target, velocity = moment.scene.targets[row], moment.velocities_mps[row]
        record: dict[str, Any] = {"class": target.type}
        record |= {name: _rounded(value) for name, value in zip(FIELDS, target.box, strict=True)}
        record |= {"track_id": moment.track_ids[row], "vx_mps": _rounded(velocity[0])}
        record |= {"vy_mps": _rounded(velocity[1]), "points": points[row], "occluded": occluded[row]}
        boxes.append(record)
    return {"time_s": time_s, "ego_pose": moment.ego_pose.round(6).tolist(), "boxes": boxes}


def simulate_sequences(
    out: str | Path,
    sequences: int,
    length: int,
    seed: int = 0,
    workers: int = 1,
    config: SimulationConfig | None = None,
    *,
    val_share: float = 0.1,
    reporter: Reporter = SILENT,
) -> Path:
    """Write `sequences` sequences of `length` scans each, at 10 Hz, below `out`; returns `out`.

    The result does not depend on the number of workers, and a run that was interrupted, or had fewer sequences, is
    resumed. Everything around the car is labelled; a field of view "camera" keeps the camera's view.

    Raises:
        ConfigError: a number below 1, or a share outside 0..1.
        DatasetError: `out` holds sequences of another seed, length or configuration.
    """
    check_counts({"sequences": sequences, "length": length, "workers": workers}, val_share)
    root = Path(out)
    config = config or SimulationConfig()
    if config.field_of_view == "full":  # as much is cast, and there is no camera to label for
        config = replace(config, field_of_view="around")
    plan = SequencePlan(seed, length, config)
    record_settings(root, {"seed": seed, "length": length, "rate_hz": RATE_HZ, **asdict(config)}, root / "scans")
    todo = [(sequence, index) for sequence in range(sequences) for index in range(length)]
    todo = [item for item in todo if not _scan_path(root, *item).exists()]
    for_each(partial(_write_frame, root, plan), todo, workers, reporter)
    first_val = sequences - held_out(sequences, val_share)
    for name, numbers in (("train", range(first_val)), ("val", range(first_val, sequences))):
        write_image_set(root, name, [f"{sequence:04d}/{index:06d}" for sequence in numbers for index in range(length)])
    write_text(root / DATASET_FILE, _DATASET)
    return root


def require_own_sequences(out: Path) -> None:
    """Make sure that `simulate_sequences` may write into `out`; OutputError names foreign files."""
    folders = [folder.relative_to(out) for name in ("scans", "labels") for folder in (out / name).glob("*/")]
    about_keys = ("seed", "length", "rate_hz", "scene", "lidar", "field_of_view")
    require_own_simulation(out, about_keys, ("scans", "labels", *folders))
    require_own_file(out / DATASET_FILE, COMMAND, starting_with(_DATASET))


@lru_cache(maxsize=1)
def _world(plan: SequencePlan, sequence: int) -> tuple[MovingScene, Firings]:
    """Return the world of a sequence, cached: a process draws a street once, not for each of its scans."""
    scene, ways, sensor = (draws_of(plan.seed, sequence, stream) for stream in (_SCENE, _WAYS, _SENSOR))
    firings = draw_firings(plan.config.lidar, sensor, plan.config.field_of_view == "camera", True)
    return draw_moving_scene(plan.config.scene, scene, ways, plan.duration_s), firings


def _rounded(value: float) -> float:
    return round(float(value), 4) + 0.0  # avoids -0


def _scan_path(root: Path, sequence: int, index: int) -> Path:
    return root / "scans" / f"{sequence:04d}" / f"{index:06d}.bin"


def _write_frame(root: Path, plan: SequencePlan, item: tuple[int, int]) -> None:
    sequence, index = item
    frame = simulate_sequence_frame(plan, sequence, index)
    labels = root / "labels" / f"{sequence:04d}" / f"{index:06d}.json"
    write_once(labels, lambda path: write_json(path, frame.labels))
    write_scan(_scan_path(root, sequence, index), frame.points)  # last: its existence shows that the frame is complete
