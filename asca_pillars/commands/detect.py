"""`asca detect`: scans in, tables, pictures and KITTI text out."""

import json
import logging
import statistics
from dataclasses import asdict
from pathlib import Path
from typing import Any, cast

import cv2
import numpy as np
from rich.console import Console
from rich.progress import track
from rich.table import Table

from asca_deploy import Detections, Detector, FrameReport, sample_scan_path
from asca_deploy.auto import summary
from asca_deploy.providers import Precision, Provider
from asca_pillars.data.kitti import Calibration, read_calibration
from asca_pillars.data.scans.scan_reader import Scan, find_scans, read_scan
from asca_pillars.files import atomic_path
from asca_pillars.pictures.visualize import draw_bev, draw_on_image, write_png

TIMED_FRAMES = 6  # at least so many are run, the first is left out: one frame alone times the warm-up


def run(
    scans: Path | None,
    out: Path,
    bundle: Path | None,
    score: float | None,
    provider: str,
    precision: str | None,
    threads: int | None,
) -> None:
    """See `asca detect --help`."""
    console = Console(markup=False)
    logging.getLogger("asca_deploy").setLevel(logging.ERROR)  # its warnings are printed below, with the scan's name
    paths = find_scans(sample_scan_path() if scans is None else scans)
    detector = Detector(
        bundle,
        provider=cast("Provider", provider),  # checked by Detector, as the precision is
        precision=cast("Precision | None", precision),
        threads=threads,
        score_threshold=score,
    )
    if detector.candidates:
        console.print(summary(detector.runs_on, detector.candidates), soft_wrap=True)
    reports: list[FrameReport] = []
    results: list[tuple[Path, Detections]] = []
    dropped: list[int] = []
    for path in track(paths, "Detecting", console=console, disable=len(paths) == 1):
        scan = read_scan(path)
        detections = detector(scan.points)
        reports.append(detections.report)
        results.append((path, detections))
        dropped.append(scan.dropped_points + detections.report.non_finite_points)
        _write(out, path, scan, detections, detector)
    console.print(_table_of_boxes(*results[0]) if len(results) == 1 else _table_of_scans(results, reports))
    for path, report in zip(paths, reports, strict=True):
        for warning in report.warnings:
            console.print(f"{path.name}: {warning}", style="yellow")
    if any(dropped):
        scans_hit = sum(map(bool, dropped))
        console.print(f"{sum(dropped)} points of {scans_hit} scan(s) are not finite and were dropped", style="yellow")
    while len(reports) < TIMED_FRAMES:
        reports.append(detector(scan.points).report)
    console.print(_timing(reports[1:], detector))
    console.print(f"Pictures and results: {out}/")


def _write(out: Path, path: Path, scan: Scan, detections: Detections, detector: Detector) -> None:
    """NAME.json and NAME_bev.png; with a KITTI calibration NAME.txt, with an image NAME_image.png too."""
    with atomic_path(out / f"{path.stem}.json") as temporary:
        temporary.write_text(json.dumps(_to_json(path, scan, detections), indent=1), encoding="utf-8")
    write_png(out / f"{path.stem}_bev.png", draw_bev(scan.points, detections, detector.spec.ranges))
    calib_path = path.parent.parent / "calib" / f"{path.stem}.txt"
    if path.parent.name != "velodyne" or not calib_path.exists():
        return
    calibration = read_calibration(calib_path)
    image_path = path.parent.parent / "image_2" / f"{path.stem}.png"
    image = cv2.imread(str(image_path)) if image_path.exists() else None
    _write_kitti(out / f"{path.stem}.txt", detections, calibration, image)
    if image is not None:
        drawn = draw_on_image(image, detections.boxes, detections.names, detections.scores, calibration)
        write_png(out / f"{path.stem}_image.png", drawn)


def _write_kitti(path: Path, detections: Detections, calibration: Calibration, image: Any) -> None:
    """What the camera sees, as KITTI's tools want it: they know no boxes outside the image."""
    size_wh = None if image is None else (image.shape[1], image.shape[0])
    with atomic_path(path) as temporary:
        temporary.write_text(detections.to_kitti(calibration, size_wh), encoding="utf-8")


def _to_json(path: Path, scan: Scan, detections: Detections) -> dict[str, Any]:
    report = detections.report
    return {
        "scan": path.name,
        "frame": "lidar: x forward, y left, z up; box centers; yaw counter-clockwise from x",
        "boxes": detections.to_dicts(),
        **asdict(report.counts),
        "points_not_finite": scan.dropped_points + report.non_finite_points,
        "reflectances_clipped": report.clipped_reflectances,
        "outputs_not_finite": report.non_finite_outputs,
        "warnings": list(report.warnings),
    }


def _table_of_boxes(path: Path, detections: Detections) -> Table:
    table = Table(title=f"{path.name}: {len(detections)} objects")
    for column in ("class", "score", "distance", "size l x w x h", "heading"):
        table.add_column(column, justify="left" if column == "class" else "right")
    for index in np.argsort(detections.distances_m):
        length, width, height, yaw = detections.boxes[index, 3:]
        table.add_row(
            detections.names[index],
            f"{detections.scores[index]:.2f}",
            f"{detections.distances_m[index]:.1f} m",
            f"{length:.1f} x {width:.1f} x {height:.1f} m",
            f"{np.rad2deg(yaw):+.0f}°",
        )
    return table


def _table_of_scans(results: list[tuple[Path, Detections]], reports: list[FrameReport]) -> Table:
    names = results[0][1].class_names
    table = Table(title=f"{len(results)} scans")
    for column in ("scan", "points", *names, "time"):
        table.add_column(column, justify="left" if column == "scan" else "right")
    for (path, detections), report in zip(results, reports, strict=True):
        counts = [str((detections.labels == index).sum()) for index in range(len(names))]
        table.add_row(path.name, str(report.counts.points), *counts, f"{report.total_ms:.0f} ms")
    return table


def _timing(reports: list[FrameReport], detector: Detector) -> str:
    medians = {s: statistics.median(r.times_ms[s] for r in reports) for s in reports[0].times_ms}
    total_ms = statistics.median(report.total_ms for report in reports)
    stages = " + ".join(f"{stage} {value:.1f}" for stage, value in medians.items())
    return (
        f"{1e3 / total_ms:.1f} FPS: {total_ms:.1f} ms per scan (median of {len(reports)} warm frames, "
        f"{detector.runs_on}, {detector.threads} threads): {stages} ms"
    )
