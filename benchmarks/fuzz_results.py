"""Results of `benchmarks.fuzz`: files that commands write and resume from or recognize their own folders by."""

import json
from collections.abc import Callable
from contextlib import redirect_stdout
from functools import partial
from io import StringIO
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from asca_deploy import Detections, sample_scan_path, shipped_bundles
from asca_deploy.browser_page import ORT_FILES, write_page
from asca_deploy.recordings.foxglove_file import is_own_mcap
from asca_deploy.recordings.rerun_file import is_own_rrd
from asca_deploy.recordings.results import JOURNAL_FILE, Journal, ScanResult
from asca_deploy.result_files import ResultWriter
from asca_pillars.base.errors import AscaError, OutputError
from asca_pillars.base.files import require_writable
from asca_pillars.base.own_files import page_end
from asca_pillars.base.schema import to_dict
from asca_pillars.base.system import describe_environment
from asca_pillars.cluster import Shard, ShardFolder
from asca_pillars.config.tree import Config, load_config
from asca_pillars.data.boxes.box_split import BoxSplit
from asca_pillars.data.boxes.detector_scope import DetectorScope
from asca_pillars.data.importing.imported import MARKER, require_own_dataset
from asca_pillars.data.kitti import write_image_set
from asca_pillars.evaluation import report_files as eval_files
from asca_pillars.evaluation.boxes.box_predictions import read_box_predictions
from asca_pillars.evaluation.tracking_report import tracking_report
from asca_pillars.pictures.visualize import png_bytes
from asca_pillars.scans.scan_reader import read_scan, write_scan
from asca_pillars.sim.simulation import require_own_frames
from asca_pillars.training.run_files import YAML_HEAD, require_own_run
from benchmarks.fuzz_inputs import BOX, Kind

CLASSES = ("Car", "Pedestrian")
ABOUT = {"recording": "drive.mcap", "files": [["drive.mcap", 1, 2]], "topic": "/lidar", "model": {}, "runs_on": "cpu"}
SCANS = 5


def kinds(folder: Path) -> list[Kind]:
    """Return every kind of result that a command resumes from; the files of each are written below `folder`."""
    return [*_gone_on_from(folder), *_boxes(folder), _page(folder), *_marks(folder)]


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
    root, found, tracks = folder / "boxes", folder / "found", folder / "tracks"
    names = [f"{number:06d}" for number in range(2)]
    records = [{**BOX, "class": name, "score": 0.5, "track_id": number} for number, name in enumerate(("Car", "Truck"))]
    lines = "".join(json.dumps({"scan": f"{name}.bin", "time_s": 0.5, "boxes": records}) + "\n" for name in names)
    for name in names:
        write_scan(root / "scans" / f"{name}.bin", np.full((8, 4), 0.5, np.float32))
    (root / "dataset.yaml").write_text("labels: labels.jsonl\n")
    (root / "labels.jsonl").write_text(lines)
    write_image_set(root, "val", names)
    split = BoxSplit(root, "val")
    found.mkdir()
    tracks.mkdir()
    (tracks / "detections.jsonl").write_text(lines)
    rows = f"scan,{','.join(BOX)},score\n000000.bin,{','.join(map(str, BOX.values()))},0.5\n"
    about = json.dumps({**ABOUT, "classes": ["Car", "Truck"], "ranges_m": [[0, 60], [-30, 30]], "tracks": True})

    def predictions(path: Path) -> Any:
        return [frame.detections for frame in read_box_predictions(path, split).frames]

    def track_scores(path: Path) -> Any:
        return [one.clear.labels for one in tracking_report(split, path.parent, "fuzz", {}).scores]

    return [
        Kind("predictions .jsonl", found / "detections.jsonl", (lines.encode(),), predictions, 2.0),
        Kind("predictions .csv", found / "boxes.csv", (rows.encode(),), predictions, 2.0),
        Kind("tracks", folder / "tracks_of" / "detections.jsonl", (lines.encode(),), track_scores),
        Kind("recording.json", tracks / "recording.json", (about.encode(),), track_scores),
    ]


def _page(folder: Path) -> Kind:
    """Return the kind of a foreign bundle.json, from which a page is made."""
    source, bundle, package = shipped_bundles()["default"], folder / "bundle", folder / "onnxruntime-web"
    bundle.mkdir()
    for name in ("pfn.onnx", "encoder.onnx", "backbone.onnx", "main.js", "index.html", "x.mjs"):  # in a foreign bundle
        graph = name if name.endswith(".onnx") else "backbone.onnx"
        (bundle / name).symlink_to(source / graph)
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
    found = b"Car -1 -1 1.85 387.63 181.54 423.81 203.12 1.67 1.87 3.69 -16.53 2.39 58.49 1.57 0.900000\n"

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
        ("ImageSets/train.txt", (b"0\n", b"0002/000000\n"), require_own_frames, {"simulation.json": about}),
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
