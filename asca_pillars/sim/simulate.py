"""Datasets of simulated scans or drives, as of `asca simulate`."""

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from asca_pillars.base.errors import ConfigError
from asca_pillars.base.installation import require
from asca_pillars.base.progress import Progress, Remark, Reporter

FRAMES, LENGTH = 100, 100


@dataclass(frozen=True)
class Simulated:
    """Simulated dataset.

    Attributes:
        out: its folder, for `train` and `evaluate`.
        scans: folder of its scans, for `detect_scans`.
        frames: number of frames.
    """

    out: Path
    scans: Path
    frames: int


def simulate(
    out: str | Path,
    frames: int | None = None,
    *,
    sequences: int | None = None,
    length: int | None = None,
    seed: int = 0,
    workers: int = 1,
    config: str | None = None,
    view: Literal["full", "camera", "around"] | None = None,
    val_share: float = 0.1,
    cluster: str | None = None,
    progress: Progress | None = None,
    remark: Remark | None = None,
) -> Simulated:
    """Write labelled scans of simulated streets in KITTI's layout, or short drives as a dataset of boxes.

    Args:
        out: the folder; an interrupted run is resumed.
        frames: single scans to write; None: 100.
        sequences: drives to write instead.
        length: scans of each drive at 10 Hz; None: 100.
        seed: the same seed gives the same bytes, whatever the number of workers.
        workers: processes, without a cluster. A script that uses more than one needs `if __name__ == "__main__":`.
        config: YAML of scenes and sensor, or the name of one that ships; None: KITTI's.
        view: "full", "camera" or "around", see `SimulationConfig`; None: that of the config.
        val_share: share of the frames in ImageSets/val.txt.
        cluster: address of a Ray cluster that does the work.
        progress: called after each scan.
        remark: called with what a cluster has to say.

    Raises:
        AscaError: an argument cannot be used, or `out` holds something else.
    """
    if cluster is not None:
        require("cluster")
    if length is not None and sequences is None:
        raise ConfigError(f"--length {length} is for drives: give --sequences N, too, or --frames N for single scans")
    if sequences is not None and (frames is not None or cluster is not None):
        raise ConfigError("--sequences: leave --frames and --cluster out; they are for single scans")
    from asca_pillars.sim.sequence_files import require_own_sequences, simulate_sequences
    from asca_pillars.sim.simulation import load_simulation_config, require_own_frames
    from asca_pillars.sim.simulation import simulate as write_frames

    out = Path(out)
    settings = load_simulation_config(config, view)
    reporter = Reporter(progress, remark)
    if sequences is not None:
        require_own_sequences(out)
        length = length or LENGTH
        simulate_sequences(out, sequences, length, seed, workers, settings, val_share=val_share, reporter=reporter)
        return Simulated(out, out / "scans", sequences * length)
    frames = frames or FRAMES
    require_own_frames(out)
    write_frames(out, frames, seed, workers, settings, val_share, reporter, cluster=cluster)
    return Simulated(out, out / "training" / "velodyne", frames)
