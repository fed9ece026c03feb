"""Training on scans without labels: `asca adapt`."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from asca_deploy.bundle import BUNDLE_FOLDER, Bundle
from asca_deploy.detect_scans import detect_scans
from asca_deploy.open_model import RuntimeOptions
from asca_deploy.result_files import RUN_FILE
from asca_deploy.shipped import find_checkpoint
from asca_pillars.base.errors import ConfigError, ScanError
from asca_pillars.base.files import atomic_path
from asca_pillars.base.installation import require
from asca_pillars.base.own_files import require_replaceable
from asca_pillars.base.progress import Progress, Remark, Reporter
from asca_pillars.data.importing.imported import drop_unwritable, require_own_dataset, write_imported
from asca_pillars.data.importing.tool_labels import read_box_files
from asca_pillars.scans.find_scans import evenly_spaced, find_scans
from asca_pillars.scans.recordings.recorded_scans import RecordedScans, is_recording, open_recording
from asca_pillars.scans.scan_settings import ScanSettings

if TYPE_CHECKING:
    from lightning.pytorch.callbacks import ProgressBar

_STUDENT, _LABELLER, _CONFIG = "default", "accurate", "fine_tune"
_SHARES = (0.5, 0.5)  # of the trained weights and of the first ones
_VAL_SHARE = 0.2
_AS_TRAINED = ScanSettings()


@dataclass(frozen=True)
class AdaptResult:
    """A detector that has learnt from scans without labels.

    Attributes:
        bundle: its manifest.
        train, val: scans that were trained and validated on.
        boxes: boxes on them that stood for labels, by class.
        remarks: what is odd about the scans.
    """

    bundle: Bundle
    train: int
    val: int
    boxes: Mapping[str, int]
    remarks: tuple[str, ...]


def adapt(
    scans: str | Path,
    out: str | Path,
    *,
    frames: int = 250,
    topic: str | None = None,
    reading: ScanSettings = _AS_TRAINED,
    devices: str = "auto",
    progress: Progress | None = None,
    remark: Remark | None = None,
    bar: "ProgressBar | None" = None,
    step: Callable[[str], None] | None = None,
) -> AdaptResult:
    """Train `default` on with the boxes that `accurate` finds in scans without labels; what `asca adapt` does.

    The first weights remain the teacher of the training (arXiv 1503.02531), and what is exported is the average of
    both, in 8 bits. After Ctrl-C the same call resumes.

    Args:
        scans: a folder of scans, or a recording.
        out: folder of the bundle; an earlier bundle there is replaced. Boxes, checkpoints and a recording's scans go
            to a folder beside it, with `_run` after its name.
        frames: at most so many scans, evenly spaced, are learnt from.
        topic: of a recording: the topic of its scans; None: the only one.
        reading: how the scans are read and the sensor was mounted.
        devices: number of devices on this machine, or `auto`.
        progress: called after each scan and each step of the training.
        remark: called with what is odd about the scans and the run.
        bar: shows the training in place of `progress` and `remark`.
        step: called with a description of each step of the export.

    Raises:
        ScanError: there are no scans, none can be read, or nothing is found in them.
        AscaError: `out` or the folder beside it holds something else, or the training cannot be run.
    """
    require("train")
    from asca_export.export_checkpoint import export
    from asca_pillars.training.average_weights import average_checkpoints
    from asca_pillars.training.run_files import require_own_run
    from asca_pillars.training.train import train

    out = Path(out)
    run = run_folder(out)
    first, reporter = find_checkpoint(_STUDENT), Reporter(progress, remark)
    require_replaceable(out, *BUNDLE_FOLDER)  # before minutes of work
    require_own_dataset(run / "data")
    require_own_run(run / "training", first)
    source = Path(scans)
    if topic is not None and not is_recording(source):
        raise ConfigError(f"topic {topic}: {source} is not a recording; leave it out")
    if is_recording(source):
        folder = run / "scans"
        paths = _write_scans(source, topic, folder, frames, reading, reporter)
        reading = replace(reading, reflectance_scale=1.0, columns=None)
    else:
        folder = source if source.is_dir() else source.parent
        paths = evenly_spaced(find_scans(source), frames)
    found = detect_scans(
        paths,
        run / "boxes",
        options=RuntimeOptions(bundle=_LABELLER),
        reading=reading,
        around=False,  # the ranges of the training
        pictures=False,
        progress=progress,
        failed=reporter.remark,
    )
    for line in found.remarks:
        reporter.remark(line)
    if not any(len(scan.detections) for scan in found):
        raise ScanError(
            f"{scans}: {_LABELLER} finds nothing in {len(found)} scans, so there is nothing to learn; look at them "
            "with `asca view`, and describe how they lie (docs/SENSORS.md)"
        )
    imported = drop_unwritable(read_box_files(run / "boxes" / RUN_FILE, folder, reading))
    counts = write_imported(run / "data", imported, _VAL_SHARE)
    last = train(
        _CONFIG, run / "data", run / "training", devices=devices, init=first, progress=progress, remark=remark, bar=bar
    )
    average = last.with_name("average.ckpt")  # in the run's folder, whose command the bundle then states
    average_checkpoints([last, first], average, _SHARES)
    bundle = export(
        average,
        out,
        trained_on=f"{_STUDENT}, and boxes of {_LABELLER} on {counts.train} scans without labels",
        int8=True,
        with_weights=True,
        progress=progress,
        step=step,
    )
    return AdaptResult(bundle, counts.train, counts.val, counts.boxes, tuple(reporter.remarks))


def run_folder(out: Path) -> Path:
    """Return the folder of boxes, checkpoints and a recording's scans."""
    return out.with_name(f"{out.resolve().name}_run")


def _write_scans(
    path: Path, topic: str | None, folder: Path, frames: int, reading: ScanSettings, reporter: Reporter
) -> list[Path]:
    """Write at most `frames` scans of a recording, evenly spaced, to `folder`, and return their paths."""
    require("recordings")
    recording = open_recording(path, reporter)
    scans = RecordedScans(recording, recording.point_cloud_topic(topic), reading.reflectance_scale)
    folder.mkdir(parents=True, exist_ok=True)
    chosen = set(evenly_spaced(range(scans.topic.messages), frames))
    paths = []
    for item in reporter.track(scans.read(), "Reading scans", scans.topic.messages):
        if item.scan is not None and item.number in chosen:
            paths.append(folder / f"{item.number:06d}.npy")
            with atomic_path(paths[-1]) as temporary, temporary.open("wb") as file:
                np.save(file, item.scan.points)
    return paths
