"""Report of an evaluation without a camera: the same tables on the console, as Markdown and as JSON."""

from collections import Counter
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from math import isnan
from typing import Any, Literal

import numpy as np

from asca_pillars.evaluation.boxes.argoverse_metrics import ArgoverseScore, argoverse_scores
from asca_pillars.evaluation.boxes.box_pairs import BANDS
from asca_pillars.evaluation.boxes.box_predictions import BoxFrames
from asca_pillars.evaluation.boxes.iou_metrics import IOUS, MATCH_M, FixedScore, IouScore, iou_scores
from asca_pillars.evaluation.boxes.nuscenes_metrics import DISTANCES_M, NuScenesScore, nuscenes_scores
from asca_pillars.evaluation.report_page import TextTable

BoxProtocol = Literal["iou", "distance"]

BAND_IOU = 0.5  # of the table by band
_ALL = "all"


@dataclass(frozen=True)
class BoxReport:
    """Result of an evaluation by one of the box protocols, with all its numbers."""

    subject: str
    """Description of the model or file and the data."""
    protocol: BoxProtocol
    frames: BoxFrames
    class_names: tuple[str, ...]
    iou: Sequence[IouScore]
    nuscenes: Sequence[NuScenesScore]
    argoverse: Sequence[ArgoverseScore]
    at_score: Sequence[FixedScore]
    about: dict[str, Any]
    """Model, command, machine and versions, for the JSON."""

    @property
    def title(self) -> str:
        """Subject and number of frames."""
        return f"{self.subject}: {self.frames.shortage or f'{len(self.frames)} frames'}"


def box_report(
    subject: str,
    protocol: BoxProtocol,
    frames: BoxFrames,
    class_names: tuple[str, ...],
    at_score: Sequence[FixedScore],
    about: dict[str, Any],
) -> BoxReport:
    """Evaluate `class_names` by a protocol."""
    by_iou, given = protocol == "iou", frames.frames
    return BoxReport(
        subject,
        protocol,
        frames,
        class_names,
        iou_scores(given, class_names) if by_iou else (),
        () if by_iou else nuscenes_scores(given, class_names),
        () if by_iou else argoverse_scores(given, class_names),
        at_score,
        about,
    )


def box_tables(report: BoxReport) -> list[TextTable]:
    """Return the tables of AP or distance metrics, the same by band, recall and precision."""
    metrics = [_iou_table(report)] if report.protocol == "iou" else [_nuscenes_table(report), _argoverse_table(report)]
    return [*metrics, _band_table(report), _score_table(report)]


def box_notes(report: BoxReport) -> list[str]:
    """Return notes on the tables: classes left out, objects not counted, best scores."""
    types = Counter(kind for frame in report.frames.frames for kind in frame.object_types)
    others = [f"{name} ({count})" for name, count in types.items() if name not in report.class_names]
    hidden = sum(int((~frame.visible).sum()) for frame in report.frames.frames)
    notes = [f"Labelled, but no class that is evaluated: {', '.join(others)}"] if others else []
    if scope_note := _scope_note(report):
        notes.append(scope_note)
    if hidden:
        notes.append(f"{hidden} labelled boxes hold no point and count neither as missed nor as found")
    best = [
        f"{item.class_name}={item.best_score:.2f}"
        for item in report.at_score
        if item.band == _ALL and item.best_score is not None
    ]
    if best:
        notes.append(f"Scores with the best F1 on this data, within {MATCH_M:g} m: {', '.join(best)}")
    return notes


def _scope_note(report: BoxReport) -> str | None:
    scope = report.frames.scope
    if scope is None:
        return (
            "The predictions do not state the detector's ranges: labelled boxes count in every direction, and those "
            "outside the ranges as missed"
        )
    count = outside = 0
    for frame in report.frames.frames:
        evaluated = np.array([kind in report.class_names for kind in frame.object_types], bool) & frame.visible
        count += int(evaluated.sum())
        outside += int((evaluated & ~scope.holds(frame.objects)).sum())
    if not outside:
        return None
    return (
        f"{outside} of {count} labelled boxes of these classes lie outside the detector's ranges, {scope.where()}; "
        "they count, as missed"
    )


def box_json(report: BoxReport) -> dict[str, Any]:
    """Return the whole report; AP and CDS in percent."""
    metrics: dict[str, Any] = {"iou": [asdict(item) for item in report.iou]}
    if report.protocol == "distance":
        metrics = {
            "nuscenes": [asdict(item) for item in report.nuscenes],
            "argoverse2": [asdict(item) for item in report.argoverse],
        }
    return {
        "protocol": report.protocol,
        "subject": report.subject,
        "frames": len(report.frames),
        "frames_without_predictions": list(report.frames.without_predictions),
        "shortage": report.frames.shortage,
        **metrics,
        "at_score": [asdict(item) | {"recall": item.recall, "precision": item.precision} for item in report.at_score],
        "notes": box_notes(report),
        **report.about,
    }


def _iou_table(report: BoxReport) -> TextTable:
    titles = {"3d": "3D", "bev": "BEV"}
    columns = [(metric, least) for metric in titles for least in IOUS]
    everywhere = [item for item in report.iou if item.band == _ALL]
    rows = []
    for name in report.class_names:
        scores = [item for item in everywhere if item.class_name == name]
        values: dict[tuple[str, float], float | None] = {(item.metric, item.min_iou): item.ap for item in scores}
        rows.append((name, str(scores[0].objects), *(_percent(values[column]) for column in columns)))
    means = [_mean([item.ap for item in everywhere if (item.metric, item.min_iou) == column]) for column in columns]
    heads = [f"{titles[metric]}\n{least:g}" for metric, least in columns]
    return TextTable(
        "AP by 3D and BEV IoU", ("class", "objects", *heads), (*rows, ("mean", "", *map(_percent, means))), left=1
    )


def _nuscenes_table(report: BoxReport) -> TextTable:
    scores = [item for item in report.nuscenes if item.band == _ALL]
    rows = []
    for item in scores:
        by_distance = [None] * len(DISTANCES_M) if item.ap_by_distance is None else list(item.ap_by_distance)
        own_errors = (_decimal(item.ate_m), _decimal(item.ase), _decimal(item.aoe_rad))
        rows.append((item.class_name, _percent(item.ap), *map(_tenth, by_distance), *own_errors))
    mean = ("mean", _percent(_mean([item.ap for item in scores])))
    errors = [_decimal(_mean([getattr(item, name) for item in scores])) for name in ("ate_m", "ase", "aoe_rad")]
    heads = ("class", "AP", *(f"AP\n{limit:g} m" for limit in DISTANCES_M), "ATE\nm", "ASE", "AOE\nrad")
    return TextTable("nuScenes' metrics", heads, (*rows, (*mean, *[""] * len(DISTANCES_M), *errors)), left=1)


def _argoverse_table(report: BoxReport) -> TextTable:
    fields = ("ap", "ate_m", "ase", "aoe_rad", "cds")
    show = (_percent, _decimal, _decimal, _decimal, _percent)
    rows = [
        (
            item.class_name,
            str(item.objects),
            *(form(getattr(item, name)) for name, form in zip(fields, show, strict=True)),
        )
        for item in report.argoverse
    ]
    means = [_mean([getattr(item, name) for item in report.argoverse]) for name in fields]
    last = ("mean", "", *(form(value) for value, form in zip(means, show, strict=True)))
    return TextTable(
        "Argoverse 2's metrics", ("class", "objects", "AP", "ATE\nm", "ASE", "AOE\nrad", "CDS"), (*rows, last), left=1
    )


def _band_table(report: BoxReport) -> TextTable:
    if report.protocol == "iou":
        title = f"3D AP at IoU {BAND_IOU:g} by distance and direction (objects)"
        values = {
            (item.class_name, item.band): (item.ap, item.objects)
            for item in report.iou
            if (item.metric, item.min_iou) == ("3d", BAND_IOU)
        }
    else:
        title = "nuScenes' AP by distance and direction (objects)"
        values = {(item.class_name, item.band): (item.ap, item.objects) for item in report.nuscenes}
    bands = [band for band in BANDS if band != _ALL]
    rows = [
        (name, *(f"{_percent(ap)} ({count})" for ap, count in (values[name, band] for band in bands)))
        for name in report.class_names
    ]
    return TextTable(title, ("class", *bands), tuple(rows), left=1)


def _score_table(report: BoxReport) -> TextTable:
    rows = [
        (
            item.class_name,
            item.band,
            f"{item.score:.2f}",
            str(item.objects),
            str(item.detections),
            str(item.found),
            _percent(None if item.recall is None else 100 * item.recall),
            _percent(None if item.precision is None else 100 * item.precision),
        )
        for item in report.at_score
    ]
    heads = ("class", "where", "score", "objects", "boxes", "found", "recall", "precision")
    return TextTable(f"Recall and precision at a fixed score, centers within {MATCH_M:g} m", heads, tuple(rows))


def _mean(values: Sequence[float | None]) -> float | None:
    known = [value for value in values if value is not None and not isnan(value)]
    return float(np.mean(known)) if known else None


def _percent(value: float | None) -> str:
    return "-" if value is None else f"{value:.2f}"


def _tenth(value: float | None) -> str:
    return "-" if value is None else f"{value:.1f}"


def _decimal(value: float | None) -> str:
    return "-" if value is None else f"{value:.3f}"
