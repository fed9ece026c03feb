"""Detection in very many scans on the workers of a cluster, into one file: `asca detect --cluster`."""

import hashlib
import json
import logging
import socket
import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import NamedTuple

from asca_deploy.bundle import MANIFEST
from asca_deploy.detector import Detector
from asca_deploy.manifest import load_bundle
from asca_deploy.open_model import RuntimeOptions, files_need_around, open_detector
from asca_deploy.result_files import (
    COMMAND,
    RUN_FILE,
    UNREADABLE_FILE,
    as_line,
    remove_companions,
    require_own_results,
    scan_content,
)
from asca_deploy.shipped import find_bundle
from asca_pillars.base.errors import BundleError, ClusterError, ConfigError, ScanError
from asca_pillars.base.files import atomic_path
from asca_pillars.base.installation import require
from asca_pillars.base.own_files import json_object, require_own
from asca_pillars.base.progress import Progress, Remark, Reporter
from asca_pillars.base.schema import to_dict
from asca_pillars.base.system import package_versions
from asca_pillars.cluster import RUN_SETTINGS, Shard, ShardFolder, make_shards, run_shards
from asca_pillars.data.boxes.detector_scope import detector_scope
from asca_pillars.detection.spec import ScoreThresholds
from asca_pillars.scans.mounting import Mounting
from asca_pillars.scans.scan_reader import ReflectanceScale, Scan, read_scan
from asca_pillars.scans.scan_settings import ScanInput, ScanSettings

SHARDS = "shards"
_SHARD_SCANS = (16, 256)
"""Smallest and largest shard. The largest takes some ten seconds, so that little is repeated; with the smallest, the
cost of a shard is still small beside that of its scans."""
_SHARDS_WANTED = 256
READ_AGAIN_AFTER_S = (1.0, 5.0)
"""Pauses before a scan that the system cannot read is tried again, for network mounts that fail now and then."""
_ERROR = '{"error": '


class ArchiveCounts(NamedTuple):
    """Scans with results, and scans that could not be read."""

    detected: int
    unreadable: int


@dataclass(frozen=True)
class ArchiveResult:
    """Result of `detect_archive`.

    Attributes:
        counts: of all scans.
        done_before: scans that an earlier run had done.
        repeats: how often shards were restarted after their worker died.
    """

    counts: ArchiveCounts
    done_before: int
    repeats: int


@dataclass(frozen=True, kw_only=True)
class DetectShard:
    """The job of a worker: detect in the scans of a shard, and write a line for each.

    Attributes:
        shards: folder of the shards.
        start: folder that relative paths of scans start from.
        options: of the detector; `bundle` is absolute, or the name of one that ships.
        score, mounting, around: as for `open_detector`; scores of some classes as pairs, so that a job has a hash.
        columns: as for `read_scan`.
        bundle_sha256: of the bundle that the command saw.
    """

    shards: Path
    start: Path
    options: RuntimeOptions
    score: float | tuple[tuple[str, float], ...] | None
    mounting: Mounting
    around: bool
    columns: int | None
    bundle_sha256: str

    def __call__(self, shard: Shard) -> None:
        """Detect in items (path, reflectance scale).

        Raises:
            AscaError: the detector cannot be opened here, or a folder of scans not be seen.
            OSError: the results cannot be written.
        """
        detector = _detector(self)
        lines = (self._line(detector, path, scale) for path, scale in shard.items)
        ShardFolder(self.shards).write(shard, lines)

    def _line(self, detector: Detector, path: str, scale: ReflectanceScale) -> str:
        try:
            scan = self._read(self.start / path, scale)
            scope = detector_scope(detector.spec, around=self.around)
            return as_line(scan_content(Path(path), scan, detector(scan.points), scope))
        except ClusterError:
            raise
        except ScanError as error:
            return error_line(path, str(error))
        except Exception as error:  # one scan in millions must not end a run of days
            return error_line(path, f"{type(error).__name__}: {error}")

    def _read(self, path: Path, scale: ReflectanceScale) -> Scan:
        for pause_s in (*READ_AGAIN_AFTER_S, None):
            try:
                return read_scan(path, columns=self.columns, reflectance_scale=scale)
            except ScanError as error:
                if not path.parent.is_dir():  # the command has seen it
                    host = socket.gethostname()
                    raise ClusterError(f"{host}: does not see {path.parent}; mount it on every machine") from None
                system = error.__cause__
                if pause_s is None or not isinstance(system, OSError) or isinstance(system, FileNotFoundError):
                    raise
                time.sleep(pause_s)
        raise AssertionError("the last try returns or raises")


def error_line(path: str, reason: str) -> str:
    """Return the line of a scan without results."""
    return json.dumps({"error": reason, "scan": path}) + "\n"


def detect_archive(
    scans: Sequence[Path],
    out: Path,
    *,
    address: str,
    options: RuntimeOptions,
    reading: ScanSettings,
    score: ScoreThresholds | None = None,
    around: bool | None = None,
    progress: Progress | None = None,
    remark: Remark | None = None,
) -> ArchiveResult:
    """Detect in all scans on a cluster and write OUT/detections.jsonl; what an earlier run has done is not done again.

    Args:
        scans: files, see `name_scans`.
        out: folder that every machine mounts at the same place.
        address: of the cluster: HOST:PORT, auto, or local.
        options: which model runs, and how.
        reading: how the files are read and the sensor was mounted.
        score: report detections from this score on, or by class; None: the thresholds of the model.
        around: detect in every direction, see `asca_deploy.around`; None: if the first scan lies all around the sensor.
        progress: called while it is found out what an earlier run has done, and after each shard.
        remark: called with what was decided for a folder, and which cluster it is.

    Raises:
        AscaError: an option cannot be used, the cluster not be reached, or no scan can be read.
    """
    reporter = Reporter(progress, remark)
    scan_input = ScanInput(reading, scans)
    require("cluster")
    if options.provider == "auto":
        raise ConfigError("--provider auto: each machine would choose its own; name one provider with --cluster")
    is_run = json_object("shard_size", "settings")
    require_own_results(out, {f"{SHARDS}/{RUN_SETTINGS}": is_run})
    require_own(out / SHARDS, COMMAND, {RUN_SETTINGS: is_run})
    around = files_need_around(options, scan_input) if around is None else around
    for line in scan_input.notes:
        reporter.remark(line)
    job = _job(scan_input.mounting, reading.columns, options, out, score=score, around=around)
    folder = ShardFolder(job.shards)
    shard_size = min(max(len(scans) // _SHARDS_WANTED, _SHARD_SCANS[0]), _SHARD_SCANS[1])
    size = folder.begin(_results_depend_on(job, scans), shard_size)
    shards = make_shards([(str(path), scan_input.scale(path)) for path in scans], size)
    complete = folder.done(reporter.track(shards, "Checking what is done"))
    todo = [shard for shard in shards if shard.name not in complete]
    done = len(scans) - sum(len(shard.items) for shard in todo)
    repeats = _process(job, folder, todo, done, address, reporter)
    counts = merge(folder.lines(shards), out)
    if not counts.detected:
        raise ScanError(f"none of the {len(scans)} scans can be read; the reasons are in {out / UNREADABLE_FILE}")
    return ArchiveResult(counts, done, repeats)


def merge(lines: Iterable[str], out: Path) -> ArchiveCounts:
    """Part the lines of all shards into results and scans that could not be read, and write the two files."""
    detected = unreadable = 0
    with (
        atomic_path(out / RUN_FILE) as results_path,
        atomic_path(out / UNREADABLE_FILE) as errors_path,
        results_path.open("w", encoding="utf-8") as results,
        errors_path.open("w", encoding="utf-8") as errors,
    ):
        for line in lines:
            if line.startswith(_ERROR):
                unreadable += 1
                errors.write(line)
            else:
                detected += 1
                results.write(line)
    remove_companions(out, [UNREADABLE_FILE])
    return ArchiveCounts(detected, unreadable)


def _process(
    job: DetectShard, folder: ShardFolder, todo: Sequence[Shard], done: int, address: str, reporter: Reporter
) -> int:
    """Process the shards; return how often one was restarted."""
    if not todo:
        return 0
    whole = {shard.name for shard in todo}
    parts: list[Shard] = []
    repeats = 0
    outcomes = run_shards(
        job,
        todo,
        address,
        seen=folder.path / RUN_SETTINGS,
        folders=[folder.path],
        title="Detecting",
        done=done,
        cpus=job.options.threads or 1,
        gpus=int(job.options.provider in ("cuda", "tensorrt")),
        reporter=reporter,
    )
    for outcome in outcomes:
        repeats += outcome.repeats
        if outcome.died:
            reason = "ended the process that worked on it, every time"
            folder.write(outcome.shard, [error_line(path, reason) for path, _ in outcome.shard.items])
        if outcome.shard.name not in whole:
            parts.append(outcome.shard)
    for shard in todo:
        shard_parts = list(_within(parts, shard))
        if shard_parts:
            folder.join(shard, shard_parts)
    return repeats


def _within(parts: Sequence[Shard], shard: Shard) -> Iterator[Shard]:
    end = shard.first + len(shard.items)
    return (part for part in parts if shard.first <= part.first < end)


def _job(
    mounting: Mounting,
    columns: int | None,
    options: RuntimeOptions,
    out: Path,
    *,
    score: ScoreThresholds | None,
    around: bool,
) -> DetectShard:
    bundle = find_bundle(options.bundle)
    spec = load_bundle(bundle).spec  # a damaged one is named here, not by every worker
    if score is not None:
        spec.with_score_threshold(score)
    given = None if options.bundle is None else Path(options.bundle)
    return DetectShard(
        shards=out.absolute() / SHARDS,
        start=Path.cwd(),
        # One thread for each worker and a worker for each core give more scans a second than threads do.
        options=replace(
            options,
            bundle=given.absolute() if given is not None and given.exists() else given,
            threads=options.threads or 1,
        ),
        score=tuple(score.items()) if isinstance(score, Mapping) else score,
        mounting=mounting,
        around=around,
        columns=columns,
        bundle_sha256=bundle_digest(bundle),
    )


def _results_depend_on(job: DetectShard, scans: Sequence[Path]) -> dict[str, object]:
    """Return the settings that results depend on, as plain values."""
    relative = any(not path.is_absolute() for path in scans)
    return {
        "working_folder": str(job.start) if relative else None,
        "asca_pillars": package_versions().get("asca-pillars"),
        "bundle_sha256": job.bundle_sha256,
        "provider": job.options.provider,
        "precision": job.options.precision,
        "score": _scores(job),
        "around": job.around,
        "columns": job.columns,
        "mounting": to_dict(job.mounting),
    }


def _scores(job: DetectShard) -> ScoreThresholds | None:
    return dict(job.score) if isinstance(job.score, tuple) else job.score


@lru_cache(maxsize=1)
def _detector(job: DetectShard) -> Detector:
    """Return the detector, opened once per worker process."""
    logging.getLogger("asca_pillars").setLevel(logging.ERROR)  # warnings are in the lines
    detector = open_detector(job.options, _scores(job), job.mounting, around=job.around)
    if bundle_digest(detector.folder) != job.bundle_sha256:
        raise BundleError(f"{detector.folder}: is another bundle than the command's; give every machine the same one")
    return detector


def bundle_digest(bundle: Path) -> str:
    """Return the SHA-256 of the manifest, which holds those of the graphs."""
    return hashlib.sha256((bundle / MANIFEST).read_bytes()).hexdigest()
