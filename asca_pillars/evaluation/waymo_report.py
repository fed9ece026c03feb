"""The report of Waymo's metric: AP and APH by class, level and range, as a table and as JSON."""

from collections.abc import Sequence
from dataclasses import dataclass
from math import isfinite
from typing import Any

from asca_pillars.evaluation.predictions import ScoredFrames
from asca_pillars.evaluation.report_page import TextTable
from asca_pillars.evaluation.waymo import LEVELS, RANGES_M, WaymoScore, mean_over_classes


@dataclass(frozen=True)
class WaymoReport:
    """What was evaluated by Waymo's metric, and every number about it."""

    subject: str
    """The model or folder and the data, in words."""
    frames: ScoredFrames
    scores: Sequence[WaymoScore]
    has_points: bool
    """Whether scans told the levels."""
    about: dict[str, Any]
    """Model, command, machine and versions, for the JSON."""

    @property
    def title(self) -> str:
        """The subject, and how many frames stand behind the numbers."""
        return self.frames.titled(self.subject)


def waymo_table(report: WaymoReport) -> TextTable:
    """A row for every class and range, and the means over the classes; two columns for each level."""
    rows = []
    for name in dict.fromkeys(score.class_name for score in report.scores):
        for span in RANGES_M:
            own = [item for item in report.scores if (item.class_name, item.range_m) == (name, span)]
            by_level = sorted(own, key=lambda item: item.level)
            cells = [cell for item in by_level for cell in (_percent(item.ap), _percent(item.aph), str(item.objects))]
            rows.append((name, _range_text(span), *cells))
    for span in RANGES_M:
        means = [mean_over_classes(report.scores, level, span) for level in LEVELS]
        rows.append(("mean", _range_text(span), *(cell for ap, aph in means for cell in (_mean(ap), _mean(aph), ""))))
    columns = [f"L{level}\n{what}" for level in LEVELS for what in ("AP", "APH", "objects")]
    title = "AP and APH (%) of Waymo's metric at LEVEL_1 and LEVEL_2, 3D IoU 0.7 for vehicles and 0.5 for the others"
    return TextTable(title, ("class", "distance", *columns), tuple(rows))


def waymo_notes(report: WaymoReport) -> list[str]:
    """What one must know to read the table."""
    if report.has_points:
        return []
    return ["LEVEL_1 is not evaluated: levels come from the LiDAR points in the boxes; give --data ROOT with the scans"]


def waymo_json(report: WaymoReport) -> dict[str, Any]:
    """Everything in the report: a record for every class, level and range, and the means; percent."""
    return {
        "protocol": "waymo",
        "subject": report.subject,
        "frames": len(report.frames),
        "frames_asked": report.frames.asked,
        "frames_without_predictions": list(report.frames.without_predictions),
        "shortage": report.frames.shortage,
        "results": [
            {
                "class_name": item.class_name,
                "level": item.level,
                **_range_json(item.range_m),
                "objects": item.objects,
                "AP": item.ap,
                "APH": item.aph,
            }
            for item in report.scores
        ],
        "means": [_mean_json(report, level, span) for level in LEVELS for span in RANGES_M],
        "notes": waymo_notes(report),
        **report.about,
    }


def _mean_json(report: WaymoReport, level: int, span: tuple[float, float]) -> dict[str, Any]:
    ap, aph = (value if isfinite(value) else None for value in mean_over_classes(report.scores, level, span))
    return {"level": level, **_range_json(span), "mAP": ap, "mAPH": aph}


def _range_json(span: tuple[float, float]) -> dict[str, float | None]:
    """JSON knows no infinity: a range without an end has null there."""
    low_m, high_m = span
    return {"low_m": low_m, "high_m": high_m if isfinite(high_m) else None}


def _range_text(span: tuple[float, float]) -> str:
    low_m, high_m = span
    if isfinite(high_m):
        return f"{low_m:g}-{high_m:g} m"
    return f"{low_m:g}+ m" if low_m else "all"


def _percent(value: float | None) -> str:
    return "-" if value is None else f"{value:.2f}"


def _mean(value: float) -> str:
    return _percent(value if isfinite(value) else None)
