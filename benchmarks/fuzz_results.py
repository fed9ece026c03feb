"""Fuzzing of files that commands write and read again: journals, shards, pages of bundles, boxes, marks of folders.

    python -m benchmarks.fuzz_results --inputs 40000 --seed 7

Valid small files are changed at random, as by `benchmarks.fuzz`, and given to the function that resumes from them. It
has to succeed with the result of an undamaged file, or raise one AscaError and leave the file unchanged. Nothing may be
written outside the folder of the file. The exit code is 1 if anything else happened.
"""

import json
import os
import tempfile
import time
from collections import Counter
from collections.abc import Callable
from contextlib import redirect_stdout
from functools import partial
from io import StringIO
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer
import yaml
from rich.console import Console
from rich.progress import Progress
from rich.table import Table

from asca_deploy import Detections, sample_scan_path, shipped_bundles
from asca_deploy.browser_page import ORT_FILES, write_page
from asca_deploy.recordings.foxglove_file import is_own_mcap
from asca_deploy.recordings.journal import JOURNAL_FILE, Journal, ScanResult
from asca_deploy.recordings.rerun_file import is_own_rrd
from asca_deploy.result_files import ResultWriter
from asca_pillars.base.errors import AscaError, OutputError
from asca_pillars.base.own_files import page_end
from asca_pillars.base.schema import to_dict
from asca_pillars.base.system import describe_environment
from asca_pillars.base.writable_file import require_writable
from asca_pillars.cli.run_command import run_command
from asca_pillars.cluster.shards import Shard, ShardFolder
from asca_pillars.config.tree import Config, load_config
from asca_pillars.data.boxes.box_records import read_frame_file
from asca_pillars.data.boxes.box_split import BoxSplit
from asca_pillars.data.boxes.detector_scope import DetectorScope
from asca_pillars.data.importing.imported import MARKER, require_own_dataset
from asca_pillars.evaluation import report_files as eval_files
from asca_pillars.evaluation.boxes.box_predictions import read_box_predictions
from asca_pillars.evaluation.tracking.tracking_report import tracking_report
from asca_pillars.pictures.visualize import png_bytes
from asca_pillars.scans.scan_reader import read_scan, write_scan
from asca_pillars.sim.simulation import require_own_frames
from asca_pillars.training.run_files import YAML_HEAD, require_own_run
from benchmarks import fuzz
from benchmarks.fuzz_inputs import LABEL, Kind
from benchmarks.fuzz_inputs import kinds as input_kinds

LEFT = "left outside"
OUTCOMES = (*fuzz.OUTCOMES, LEFT)
READERS = ("config", "override", "manifest", "labels", "predictions")
"""Kinds of `benchmarks.fuzz` with which commands read results and settings."""
CLASSES = ("Car", "Pedestrian")
ABOUT = {"recording": "drive.mcap", "files": [["drive.mcap", 1, 2]], "topic": "/lidar", "model": {}, "runs_on": "cpu"}
BOX = {"x_m": 9.5, "y_m": 1, "z_m": -1, "length_m": 4, "width_m": 2, "height_m": 1.5, "yaw_rad": 0.1}
SCANS = 5


def main(
    inputs: Annotated[int, typer.Option(min=1, help="Stop after so many.")] = 2000,
    seed: Annotated[int, typer.Option(min=0)] = 0,
    first: Annotated[int, typer.Option(min=0, help="Number of the first input.")] = 0,
    kind: Annotated[str | None, typer.Option(help="Only kinds whose name contains this.")] = None,
) -> None:
    """Resume from damaged files and count the outcomes."""
    console = Console(markup=False, highlight=False, width=140)
    start = time.perf_counter()
    with tempfile.TemporaryDirectory(prefix="asca-fuzz-") as folder:
        counts, failures = fuzz_results(Path(folder), seed, inputs, first, kind, console)
    table = Table(title=f"{sum(counts.values())} inputs, seed {seed}, {time.perf_counter() - start:.0f} s")
    for column in ("kind", *OUTCOMES):
        table.add_column(column, justify="left" if column == "kind" else "right")
    for name in sorted({name for name, _ in counts}):
        table.add_row(name, *(str(counts[name, outcome]) for outcome in OUTCOMES))
    console.print(table)
    for text in failures[:20]:
        console.print(text)
    raise typer.Exit(int(bool(failures)))


def fuzz_results(
    folder: Path,
    seed: int,
    inputs: int,
    first: int = 0,
    only: str | None = None,
    console: Console | None = None,
) -> tuple[Counter[tuple[str, str]], list[str]]:
    """Resume from damaged files; return counts and failures as `fuzz.fuzz`."""
    place = folder / "some" / "where" / "below"  # paths that lead upwards stay within the compared folder
    place.mkdir(parents=True)
    chosen = [kind for kind in kinds(place) if only is None or only in kind.name]
    shares = np.array([kind.share for kind in chosen])
    for kind in chosen:
        fuzz.read(kind, kind.seeds[0])  # creates caches on first use
    counts: Counter[tuple[str, str]] = Counter()
    failures: list[str] = []
    with Progress(console=console, transient=True, disable=console is None) as progress:
        for number in progress.track(range(first, first + inputs), description="inputs"):
            rng = np.random.default_rng([seed, number])
            kind = chosen[int(rng.choice(len(chosen), p=shares / shares.sum()))]
            outside = _listing(folder, kind.path.parent)
            outcome, text = fuzz.read(kind, fuzz.damaged(kind, rng))
            if new := _listing(folder, kind.path.parent) ^ outside:
                outcome, text = LEFT, repr(sorted(new)[:3])
            counts[kind.name, outcome] += 1
            if outcome in (*fuzz.BAD, LEFT):
                failures.append(f"input {number}, {kind.name}: {outcome}: {text}")
    return counts, failures


def kinds(folder: Path) -> list[Kind]:
    """Return every kind of result that a command resumes from; the files of each are written below `folder`."""
    readers = [kind for kind in input_kinds(folder / "readers") if kind.name in READERS]
    return [*readers, *_gone_on_from(folder), *_boxes(folder), _page(folder), *_marks(folder)]


def _gone_on_from(folder: Path) -> list[Kind]:
    """Return kinds of journals and shards: intact parts are kept, others recomputed, and the results are unchanged."""
    rng = np.random.default_rng(0)
    results = []
    for number in range(SCANS):
        boxes, scores = rng.random((number, 7), np.float32), rng.random(number, np.float32)
        found = Detections(boxes, scores, np.arange(number) % len(CLASSES), CLASSES)
        results.append(ScanResult(number, number * 10**8, "lidar", found, dropped_points=number))
    results[2] = ScanResult(2, 5, "", None, "torn")
    shard = Shard(16, tuple(f"{number}.bin" for number in range(SCANS)))
    lines = [json.dumps({"scan": item, "boxes": [BOX]}) + "\n" for item in shard.items]
    journal, shards = folder / "journal" / JOURNAL_FILE, ShardFolder(folder / "shards")

    def go_on(path: Path) -> Any:
        with Journal(path.parent, ABOUT, CLASSES) as opened:
            for result in results:
                if result.number not in opened:
                    opened.add(result)
            _require(repr(list(opened.results())) == repr(results), "other results")
        return opened.done

    def work(path: Path) -> Any:
        done = shards.done([shard])
        if not done:
            try:
                list(shards.lines([shard]))
            except OutputError:
                shards.write(shard, lines)
            else:
                _require(False, "a shard that is not whole is read")
        _require(list(shards.lines([shard])) == lines, "other lines")
        return len(done)

    journals = []
    for count in (SCANS, 2, 0):
        with Journal(journal.parent, ABOUT, CLASSES) as opened:
            for result in results[:count]:
                opened.add(result)
        journals.append(journal.read_bytes())
        opened.remove()
    shards.write(shard, lines)
    path = next(shards.path.iterdir())
    return [
        Kind("journal", journal, tuple(journals), _keeping(go_on), 3.0),
        Kind("shard", path, (path.read_bytes(),), work, 3.0),
    ]


def _boxes(folder: Path) -> list[Kind]:
    root = folder / "boxes"
    names = [f"{number:06d}" for number in range(2)]
    for name in names:
        write_scan(root / "scans" / f"{name}.bin", np.full((8, 4), 0.5, np.float32))
    (root / "dataset.yaml").write_text("labels: labels.jsonl\n")
    records = [{"class": name, **BOX, "score": 0.5, "track_id": number} for number, name in enumerate(("Car", "Truck"))]
    lines = [json.dumps({"scan": f"{name}.bin", "time_s": 0.5, "boxes": records}) + "\n" for name in names]
    (root / "labels.jsonl").write_text("".join(lines))
    (root / "ImageSets").mkdir()
    (root / "ImageSets" / "val.txt").write_text("".join(f"{name}\n" for name in names))
    split = BoxSplit(root, "val")
    rows = ",".join(("scan", "class", *BOX, "score")) + "\n000000.bin,Car,9,1,-1,4,2,1.5,0,0.5\n"
    found, tracks = folder / "found", folder / "tracks"
    for one in (found, tracks):
        one.mkdir()
    (tracks / "detections.jsonl").write_text("".join(lines))
    about = json.dumps({**ABOUT, "classes": ["Car", "Truck"], "ranges_m": [[0, 60], [-30, 30]], "tracks": True})

    def predictions(path: Path) -> Any:
        return [frame.found for frame in read_box_predictions(path, split).frames]

    def track_scores(path: Path) -> Any:
        report = tracking_report(split, path.parent, "fuzz", {})
        return [one.clear.labels for one in report.scores]

    return [
        Kind("boxes .jsonl", found / "detections.jsonl", ("".join(lines).encode(),), predictions, 2.0),
        Kind("boxes .csv", found / "boxes.csv", (rows.encode(),), predictions, 2.0),
        Kind("boxes .json", found / "000000.json", (json.dumps({"boxes": records}).encode(),), read_boxes, 2.0),
        Kind("tracks", folder / "tracks_of" / "detections.jsonl", ("".join(lines).encode(),), track_scores),
        Kind("recording.json", tracks / "recording.json", (about.encode(),), track_scores),
    ]


def read_boxes(path: Path) -> Any:
    """Read the boxes of a frame's own file."""
    return read_frame_file(path).boxes


def _page(folder: Path) -> Kind:
    """Return the kind of a foreign bundle.json, from which a page is made."""
    source, bundle, package = shipped_bundles()["default"], folder / "bundle", folder / "onnxruntime-web"
    bundle.mkdir()
    for name in ("encoder.onnx", "backbone.onnx", "main.js", "index.html", "x.mjs"):  # names in a foreign bundle
        graph = "encoder" if name == "encoder.onnx" else "backbone"
        (bundle / name).symlink_to(source / f"{graph}.onnx")
    (package / "dist").mkdir(parents=True)
    (package / "package.json").write_text('{"name": "onnxruntime-web", "version": "9.9.9"}')
    for name in ORT_FILES:
        (package / "dist" / name).write_bytes(b"code")
    scan = folder / "few.bin"
    write_scan(scan, read_scan(sample_scan_path()).points[:9])
    manifest = (source / "bundle.json").read_text()
    seeds = [
        manifest.replace('"backbone.onnx"', f'"{name}"').encode() for name in ("backbone.onnx", "main.js", "x.mjs")
    ]
    write_page(folder / "usual", source, scan, package)
    usual = {path.name: path.read_bytes() for path in (folder / "usual").iterdir()}

    def page(path: Path) -> Any:
        out = path.parent / "page"
        write_page(out, path.parent, scan, package)
        written = {one.name: one.read_bytes() for one in out.iterdir()}
        _require(written.keys() == usual.keys(), "other files")
        differing = {name for name in usual if written[name] != usual[name]}
        _require(differing <= {"bundle.json", "page.json"}, "other contents")
        return len(written)

    return Kind("page", bundle / "bundle.json", tuple(seeds), page, 0.3)


def _marks(folder: Path) -> list[Kind]:
    """Return kinds of marks, which identify a command's own folder or file; checking one never changes it."""
    picture = png_bytes(np.zeros((4, 4, 3), np.uint8))
    scan = json.dumps({"scan": "1.bin", "frame": "", "boxes": [], "points_not_finite": 0}).encode()
    report = json.dumps({"subject": "", "frames_asked": 1, "results": 1, "bands": [], "operating_points": []}).encode()
    made_by = json.dumps({"model": {}, "data": "", "split": "val", "files": ["1.txt"]}).encode()
    settings = yaml.safe_dump(to_dict(Config()), sort_keys=False)
    about = json.dumps({"seed": 1, "scene": {}, "lidar": {}, "field_of_view": "full"}).encode()
    environment = json.dumps(describe_environment()).encode()
    mcap = b"\x89MCAP0\r\n\x01\x1e\0\0\0\0\0\0\0\0\0\0\0\x12\0\0\0asca-pillars boxes"
    found = f"{LABEL} 0.900000\n".replace("0.00 0", "-1 -1").encode()

    def detect(out: Path) -> None:
        with ResultWriter(out, [Path("1")], pictures=True, scope=DetectorScope((), None)):
            pass

    def evaluate(out: Path) -> None:
        eval_files.check_output_folder("report", out, None, None, ())

    def train(out: Path) -> None:
        require_own_run(out)
        load_config(out / "config.yaml")

    def foxglove(out: Path) -> None:
        require_writable(out / "boxes.mcap", "asca detect", is_own_mcap)

    def rerun(out: Path) -> None:
        require_writable(out / "scans.rrd", "asca detect", is_own_rrd)

    config, run = (YAML_HEAD + settings).encode(), {"detections.jsonl": scan}
    marks: list[tuple[str, tuple[bytes, ...], Callable[[Path], None], dict[str, bytes]]] = [
        ("detections.jsonl", (scan + b"\n" + scan + b"\n",), detect, {}),
        ("recording.json", (json.dumps(ABOUT).encode(),), detect, run),
        ("tracks.txt", (b"0 -1 " + found,), detect, run),
        ("1.json", (scan,), detect, run),
        ("1.txt", (found, b""), detect, run),
        ("1_bev.png", (picture,), detect, run),
        ("report.json", (report,), evaluate, {}),
        ("report.md", (f"# Title\n{page_end('asca eval')}".encode(),), evaluate, {"report.json": report}),
        ("predictions/made_by.json", (made_by,), evaluate, {"predictions/1.txt": found}),
        ("config.yaml", (config, settings.encode()), train, {"environment.json": environment}),
        ("environment.json", (environment,), train, {"config.yaml": config}),
        ("simulation.json", (about,), require_own_frames, {}),
        (
            "ImageSets/train.txt",
            (b"0\n1\n", b"0002/000000\n0002/000001\n"),
            require_own_frames,
            {"simulation.json": about},
        ),
        ("boxes.mcap", (mcap,), foxglove, {}),
        ("scans.rrd", (b"RRF2\0\0asca-pillars",), rerun, {}),
        ("dataset.yaml", ((MARKER + "labels: labels.jsonl\n").encode(),), require_own_dataset, {}),
    ]
    made = []
    for number, (name, seeds, look, beside) in enumerate(marks):
        out = folder / "marks" / str(number)
        for other, content in beside.items():
            (out / other).parent.mkdir(parents=True, exist_ok=True)
            (out / other).write_bytes(content)
        (out / name).parent.mkdir(parents=True, exist_ok=True)
        made.append(Kind(f"mark {name}", out / name, seeds, _keeping(partial(_look, look, out), always=True), 0.5))
    return made


def _look(look: Callable[[Path], None], out: Path, _: Path) -> None:
    look(out)


def _keeping(look: Callable[[Path], Any], *, always: bool = False) -> Callable[[Path], Any]:
    """Wrap a function: an error if the file changed after it was refused, or `always`."""

    def read(path: Path) -> Any:
        before = path.read_bytes()
        try:
            with redirect_stdout(StringIO()):
                result = look(path)
        except AscaError:
            _require(path.read_bytes() == before, "a refused file was changed")
            raise
        _require(not always or path.read_bytes() == before, "the file was changed")
        return result

    return read


def _require(holds: bool, reason: str) -> None:
    if not holds:
        raise RuntimeError(reason)


def _listing(folder: Path, target: Path) -> set[tuple[str, int]]:
    """Return every file below a folder with its size, except those below `target`."""
    found = set()
    for at, names, files in os.walk(folder):
        names[:] = [name for name in names if Path(at, name) != target]
        found |= {(f"{at}/{name}", Path(at, name).lstat().st_size) for name in files}
    return found


if __name__ == "__main__":
    run_command(main)
