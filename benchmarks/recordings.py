"""Recordings of simulated sequences through `asca detect --track`: time, dropped scans, output, HOTA.

    asca simulate data/drives --sequences 3 --length 200 --view around --seed 11
    python -m benchmarks.recordings data/drives

The sequences are written as an MCAP and a rosbag2. Each is detected with tracks by one command, whose processor time
per scan is printed; the MCAP with the boxes is read back by the format's own reader; the tracks are evaluated. Finally
a thread puts scans at their own rate into a ScanQueue that drops scans on overload, and dropped ones
are counted: that part depends on other load of the machine.
"""

import json
import resource
import subprocess
import sys
import tempfile
import threading
import time
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer

from asca_deploy import Detections, Detector, ScanQueue, Tracker
from asca_deploy.manifest import load_pillar_bundle
from asca_deploy.shipped import find_bundle
from asca_pillars.base.system import cpu_model
from asca_pillars.cli.run_command import run_command
from asca_pillars.data.boxes.box_records import FIELDS
from asca_pillars.data.boxes.box_split import BoxSplit
from asca_pillars.evaluation.report_page import markdown_table
from asca_pillars.evaluation.tracking.tracking_report import tracking_report, tracking_tables
from benchmarks.made_recordings import stamped_scans, write_recording

PACED_SCANS = 200


def main(
    data: Annotated[Path, typer.Argument(help="Dataset of simulated sequences.")],
    threads: Annotated[int, typer.Option(help="CPU threads of the detector.")] = 2,
    paced: Annotated[int, typer.Option(help="Scans that come at their own pace.")] = PACED_SCANS,
) -> None:
    """Print a line for each recording, the tracks' scores, and the number of dropped scans."""
    print(f"{cpu_model()}, {threads} threads")
    with tempfile.TemporaryDirectory(prefix="asca-recordings-") as temporary:
        folder = Path(temporary)
        for name in ("drive.mcap", "drive_bag"):
            scans = write_recording(folder / name, stamped_scans(data))
            out = folder / f"out_{name}"
            cpu_s = _detect(folder / name, out, threads)
            lines = (out / "detections.jsonl").read_text(encoding="utf-8").splitlines()
            print(
                f"{name}: {scans} scans, {len(lines)} results, {_messages(out / 'boxes.mcap')} messages read back; "
                f"{1e3 * cpu_s / scans:.1f} ms of processor time per scan, start and writing included"
            )
        report = tracking_report(BoxSplit(data), folder / "out_drive.mcap", str(data), {})
        for table in tracking_tables(report):
            print(f"\n{markdown_table(table.columns, table.rows, table.left)}")
    print(_tracker_cost([json.loads(line) for line in lines]))
    print(_paced(data, threads, paced))


def _detect(recording: Path, out: Path, threads: int) -> float:
    """Run the command; its processor time, seconds."""
    before = _children_s()
    command = [sys.executable, "-m", "asca_pillars.cli", "detect", str(recording), "--track", "-o", str(out)]
    command += ["--foxglove", str(out / "boxes.mcap"), "--threads", str(threads)]
    subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
    return _children_s() - before


def _children_s() -> float:
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def _messages(path: Path) -> int:
    from mcap.reader import make_reader

    with path.open("rb") as file:
        return sum(1 for _ in make_reader(file, validate_crcs=True).iter_messages())


def _tracker_cost(lines: list[dict[str, Any]]) -> str:
    """Return the processor time of the tracker alone, on the written boxes."""
    names = tuple(sorted({box["class"] for line in lines for box in line["boxes"]}))
    scans = []
    for line in lines:
        boxes = np.array([[box[name] for name in FIELDS] for box in line["boxes"]], np.float32).reshape(-1, 7)
        labels = np.array([names.index(box["class"]) for box in line["boxes"]], np.int64)
        scores = np.array([box["score"] for box in line["boxes"]], np.float32)
        scans.append((Detections(boxes, scores, labels, names), line["time_s"]))
    tracker = Tracker()
    tracker(*scans[0])
    start = time.process_time()
    for detections, time_s in scans:
        tracker(detections, time_s)
    each_ms = 1e3 * (time.process_time() - start) / len(scans)
    return f"\ntracker: {each_ms:.2f} ms of processor time per scan of {np.mean([len(d) for d, _ in scans]):.0f} boxes"


def _paced(data: Path, threads: int, count: int) -> str:
    """Detect in scans that arrive at their own rate; return how many were dropped."""
    queue, detector = ScanQueue("drop"), Detector(threads=threads)
    births = {one.name: one.score_threshold for one in load_pillar_bundle(find_bundle(None)).spec.classes}
    tracker = Tracker(birth_score=births)
    scans = [item for _, item in zip(range(count), stamped_scans(data), strict=False)]
    detector(scans[0][1])

    def sensor() -> None:
        start = time.perf_counter()
        for number, (time_ns, points) in enumerate(scans):
            time.sleep(max(start + number / 10 - time.perf_counter(), 0))
            queue.put(points, time_ns)
        queue.close()

    thread = threading.Thread(target=sensor)
    thread.start()
    latencies = []
    for detections in detector.stream(queue):
        tracker(detections, queue.next_tag() * 1e-9)
        latencies.append(detections.report.total_ms)
    thread.join()
    return (
        f"\n{count} scans at 10 Hz: {queue.dropped} dropped; p50 and p95 of the latency {np.median(latencies):.0f} and "
        f"{np.quantile(latencies, 0.95):.0f} ms of wall time"
    )


if __name__ == "__main__":
    run_command(main)
