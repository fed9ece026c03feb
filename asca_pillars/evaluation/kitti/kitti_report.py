"""Report of KITTI's protocol: AP, AP by distance, recall and precision, as tables, as JSON and as a plot of curves.

The plot is the only part of the evaluation that needs matplotlib.
"""

from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from math import isnan
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from asca_pillars.base.files import atomic_path
from asca_pillars.base.own_files import PICTURE_SOFTWARE
from asca_pillars.evaluation.kitti.average_precision import (
    CLASS_NAMES,
    DIFFICULTIES,
    METRICS,
    Curve,
    KittiEvaluation,
    KittiResults,
)
from asca_pillars.evaluation.kitti.score_threshold import OperatingPoint
from asca_pillars.evaluation.predictions import ScoredFrames
from asca_pillars.evaluation.report_page import TextTable

if TYPE_CHECKING:
    from matplotlib.axes import Axes


BANDS_M = {
    (0.0, 40.0): "Table 4 of ASCA-PointPillars",
    (40.0, 80.0): "Table 4 of ASCA-PointPillars",
    (0.0, 30.0): "Table 3 of Deformable PV-RCNN",
    (30.0, 50.0): "Table 3 of Deformable PV-RCNN",
}
"""Bands of the distance from the camera, and papers that report them; the ASCA paper states the mean without a
difficulty."""
METRIC_TITLES = {"bbox": "2D", "bev": "BEV", "3d": "3D", "aos": "AOS"}
SMALL_SET = 40
"""With so few counted objects the protocol's AP of a perfect detector is below 100."""
_NONE = "-"


@dataclass(frozen=True)
class KittiReport:
    """Result of an evaluation by KITTI's protocol, with all its numbers."""

    subject: str
    """Description of the model or folder and the data."""
    frames: ScoredFrames
    ap: KittiEvaluation
    points: Sequence[OperatingPoint]
    best_scores: dict[str, float]
    """Score threshold with the best F1 of each detected class."""
    about: dict[str, Any]
    """Model, command, machine and versions, for the JSON."""

    @property
    def title(self) -> str:
        """Subject and number of frames."""
        return self.frames.title_of(self.subject)


def kitti_tables(report: KittiReport) -> list[TextTable]:
    """Return the tables of AP, AP by distance, recall and precision at the fixed scores, and both by distance."""
    whole = [point for point in report.points if point.band_m is None]
    recall = [(point, point.found, point.objects, point.recall, point.recall_interval) for point in whole]
    precision = [
        (point, point.true_positives, point.detections, point.precision, point.precision_interval) for point in whole
    ]
    return [
        _ap_table(report.ap.overall),
        _band_table(report.ap),
        _share_table("Recall", ("objects", "found"), recall),
        _share_table("Precision", ("detections", "true positives"), precision),
        _share_band_table(report.points),
    ]


def kitti_notes(report: KittiReport) -> list[str]:
    """Return notes on the tables.

    Types left out, classes not evaluated, sets too small for their AP, ignored detections, best scores.
    """
    results = report.ap.overall
    lines = [_foreign_note(name, *counts) for name, counts in report.frames.foreign_types.items()]
    for name in results.class_names:
        if not any(results.curve(name, metric, DIFFICULTIES[0]) for metric in METRICS):
            lines.append(f"{name}: not evaluated, because nothing was detected as one; the means leave the class out")
        lines += [
            _cap_note(curve) for curve in _counts_of(results, name) if curve is not None and curve.counted <= SMALL_SET
        ]
    lines += [
        _ignored_note(point)
        for point in report.points
        if point.difficulty == "hard" and point.band_m is None and point.ignored > point.detections
    ]
    if report.best_scores:
        scores = ", ".join(f"{name} {score:.2f}" for name, score in report.best_scores.items())
        lines.append(f"Scores with the best F1 on this data, moderate, in 3D: {scores}")
    return lines


def kitti_json(report: KittiReport) -> dict[str, Any]:
    """Return the whole report; `results` has the shape of KITTI's: class, metric, R11 / R40 / precision."""
    return {
        "subject": report.subject,
        "frames": len(report.frames),
        "frames_asked": report.frames.requested,
        "frames_without_predictions": list(report.frames.without_predictions),
        "shortage": report.frames.shortage,
        "types_left_out": list(report.frames.foreign_types),
        "results": report.ap.overall.to_json(),
        "bands": [
            {
                "low_m": low,
                "high_m": high,
                "mean_3d_moderate_R40": band.mean_ap("3d", "moderate"),
                "results": band.to_json(),
            }
            for (low, high), band in report.ap.bands.items()
        ],
        "operating_points": [_without_nan(asdict(point)) for point in report.points],
        "best_scores": report.best_scores,
        "notes": kitti_notes(report),
        **report.about,
    }


def _ap_table(results: KittiResults) -> TextTable:
    rows: list[tuple[str, ...]] = []
    for name in results.class_names:
        counted = [_NONE if curve is None else str(curve.counted) for curve in _counts_of(results, name)]
        rows.append((name, "objects", *counted, *counted))
        for metric, title in METRIC_TITLES.items():
            curves = [results.curve(name, metric, difficulty) for difficulty in DIFFICULTIES]
            r40 = [_percent(None if curve is None else curve.r40) for curve in curves]
            r11 = [_percent(None if curve is None else curve.r11) for curve in curves]
            rows.append((name, title, *r40, *r11))
    for metric, title in METRIC_TITLES.items():
        means = [_percent(results.mean_ap(metric, difficulty)) for difficulty in DIFFICULTIES]
        rows.append(("mean", title, *means, *[""] * len(DIFFICULTIES)))
    columns = [f"{average}\n{difficulty}" for average in ("R40", "R11") for difficulty in DIFFICULTIES]
    title = "Average precision (%) of KITTI's protocol, over 40 and over 11 recall points, and the objects it counts"
    return TextTable(title, ("class", "metric", *columns), tuple(rows))


def _band_table(ap: KittiEvaluation) -> TextTable:
    names = ap.overall.class_names
    rows = tuple(
        (f"{low:g}-{high:g} m", _percent(band.mean_ap("3d", "moderate")), *(_band_cell(band, name) for name in names))
        for (low, high), band in ap.bands.items()
    )
    sources = "; ".join(dict.fromkeys(BANDS_M[band] for band in ap.bands if band in BANDS_M))
    title = f"3D AP (%, R40, moderate) by distance, in brackets the counted objects (bands of {sources})"
    return TextTable(title, ("distance", "mean", *names), rows, left=1)


def _band_cell(band: KittiResults, name: str) -> str:
    curve = band.curve(name, "3d", "moderate")
    if curve is None:
        return _NONE
    return f"{_percent(curve.r40 if curve.counted else None)} ({curve.counted})"


def _share_table(
    what: str,
    columns: tuple[str, str],
    shares: Sequence[tuple[OperatingPoint, int, int, float, tuple[float, float]]],
) -> TextTable:
    """Return a table with rows of (operating point, part, whole, share, interval)."""
    rows = tuple(
        (point.class_name, point.difficulty, str(whole), str(part), *_percents(share, interval))
        for point, part, whole, share, interval in shares
    )
    # A dictionary, unlike a set, keeps the order of the classes.
    fixed = dict.fromkeys(f"{p.class_name} {p.score:g} (IoU {p.min_overlap:g})" for p, *_ in shares)
    title = f"{what} (%) in 3D of what reaches the score: {', '.join(fixed)}"
    return TextTable(title, ("class", "difficulty", *columns, what.lower(), "95 % interval"), rows)


def _share_band_table(points: Sequence[OperatingPoint]) -> TextTable:
    """Return a table with a row for each band, and recall and precision of each class."""
    of_bands = {(p.band_m, p.class_name): p for p in points if p.band_m is not None and p.difficulty == "moderate"}
    bands, names = (tuple(dict.fromkeys(keys)) for keys in zip(*of_bands, strict=True)) if of_bands else ((), ())
    rows = tuple(
        (f"{low:g}-{high:g} m", *(_share_cell(of_bands[(low, high), name]) for name in names)) for low, high in bands
    )
    title = "Recall / precision (%) in 3D at these scores by distance, moderate, in brackets the counted objects"
    return TextTable(title, ("distance", *names), rows, left=1)


def _share_cell(point: OperatingPoint) -> str:
    recall, precision = (
        _percents(share, interval)[0]
        for share, interval in (
            (point.recall, point.recall_interval),
            (point.precision, point.precision_interval),
        )
    )
    return f"{recall} / {precision} ({point.objects})"


def _percents(share: float, interval: tuple[float, float]) -> tuple[str, str]:
    if isnan(share):  # 0 / 0
        return _NONE, _NONE
    return _percent(100 * share), f"{100 * interval[0]:.2f} - {100 * interval[1]:.2f}"


def _without_nan(values: dict[str, Any]) -> dict[str, Any]:
    """Replace NaN, which JSON does not have, by None."""
    return {key: None if isinstance(value, float) and isnan(value) else value for key, value in values.items()}


def _counts_of(results: KittiResults, name: str) -> Iterator[Curve | None]:
    """Yield for each difficulty a curve of the class; counted objects are the same for every metric."""
    for difficulty in DIFFICULTIES:
        yield next((c for metric in METRICS if (c := results.curve(name, metric, difficulty))), None)


def _cap_note(curve: Curve) -> str:
    what = f"{curve.class_name} {curve.difficulty}"
    if not curve.counted:
        return f"{what}: no counted objects; its AP of 0 says nothing"
    objects = f"only {curve.counted} counted object{'s' if curve.counted > 1 else ''}"
    return f"{what}: {objects}; a perfect detector gets at most {curve.r40_cap:.1f} R40, {curve.r11_cap:.1f} R11"


def _foreign_note(name: str, labels: int, detections: int) -> str:
    known = ", ".join(CLASS_NAMES)
    return (
        f"{name}: left out ({labels} labels, {detections} detections), because KITTI's protocol scores {known}; "
        "--protocol waymo scores any class"
    )


def _ignored_note(point: OperatingPoint) -> str:
    of_all = f"{point.ignored} of {point.ignored + point.detections} detections"
    return (
        f"{point.class_name}: {of_all} are ignored even at hard (low in the image, without 2D box, on ignored objects "
        "or DontCare areas); the precision does not count them"
    )


def _percent(value: float | None) -> str:
    return _NONE if value is None else f"{value:.2f}"


DRAWN_METRICS = {"bev": "BEV", "3d": "3D"}
_COLORS = {"easy": "#009E73", "moderate": "#0072B2", "hard": "#D55E00"}
_DASHES = {"easy": "-", "moderate": "--", "hard": ":"}


def write_curves(path: str | Path, results: KittiResults, title: str) -> None:
    """Draw precision over recall as PNG: a column for each class, BEV above 3D, a line for each difficulty.

    The curves are KITTI's: 41 samples, each the best precision at this or a higher recall; a curve ends at the highest
    recall that was reached.

    Args:
        path: path of the PNG.
        results: results with the curves; a class without any gets an empty plot with a note.
        title: title of the picture.

    Raises:
        ModuleNotFoundError: matplotlib is not installed.
    """
    # No pyplot and no backend: a Figure object has no global state and needs no display.
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    names = results.class_names
    figure = Figure(figsize=(4.2 * len(names), 3.9 * len(DRAWN_METRICS)), layout="constrained", dpi=110)
    plots = figure.subplots(len(DRAWN_METRICS), len(names), squeeze=False, sharex=True, sharey=True)
    for row, (metric, metric_title) in zip(plots, DRAWN_METRICS.items(), strict=True):
        for plot, name in zip(row, names, strict=True):
            curves = [results.curve(name, metric, difficulty) for difficulty in DIFFICULTIES]
            _draw(plot, [curve for curve in curves if curve is not None])
            plot.set_title(f"{name}, {metric_title}")
    for plot in plots[-1]:
        plot.set_xlabel("recall (%)")
    for plot in plots[:, 0]:
        plot.set_ylabel("precision (%)")
    figure.suptitle(title, wrap=True)
    with atomic_path(path) as temporary:
        FigureCanvasAgg(figure).print_png(temporary, metadata={"Software": PICTURE_SOFTWARE})


def _draw(plot: "Axes", curves: list[Curve]) -> None:
    plot.set(xlim=(0, 100), ylim=(0, 103))
    plot.grid(alpha=0.3)
    for curve in curves:
        reached = int(np.count_nonzero(curve.precision))
        recall = np.linspace(0, 100, len(curve.precision))[:reached]
        plot.plot(
            recall,
            100 * curve.precision[:reached],
            color=_COLORS[curve.difficulty],
            linestyle=_DASHES[curve.difficulty],
            linewidth=1.8,
            marker="o",
            markevery=[reached - 1] if reached else None,
            markersize=4,
            label=f"{curve.difficulty}  {curve.r40:.2f} AP R40, {curve.counted} objects",
        )
    if curves:
        plot.legend(loc="best", fontsize=8)
    else:
        plot.text(50, 50, "not evaluated:\nnothing was detected\nas this class", ha="center", va="center", color="gray")
