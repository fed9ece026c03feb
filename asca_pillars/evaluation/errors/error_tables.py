"""Tables of the error analysis: datasets and their parts as rows for every group of objects."""

from collections.abc import Sequence

from asca_pillars.evaluation.errors.box_errors import CORRECTIONS, FALSE_KINDS, LOCALIZATION_IOU, TRAITS, least_iou
from asca_pillars.evaluation.errors.error_summary import (
    BLOCK_FRAMES,
    CLEAR_RANGE_M,
    CLEAR_TRUNCATION,
    FALSE_RATES,
    LARGELY_OCCLUDED,
    MAIN_GROUPS,
    MIN_BLOCKS,
    SIDE_ON_DEG,
    WITHOUT_MEDIANS,
    ClassErrors,
    DatasetErrors,
    GroupErrors,
    Interval,
    Spread,
)
from asca_pillars.evaluation.errors.label_fit import END_ON_DEG, MAX_RANGE_M, STATISTICS
from asca_pillars.evaluation.report_page import TextTable

PRINTED_NOTES = 4
"""Number of notes needed for the first tables; the others explain traits and statistics."""
_NONE = "-"
_BOX_COLUMNS = (
    "near_end",
    "far_end",
    "length",
    "near_side",
    "far_side",
    "bottom",
    "height",
    "range",
    "left",
    "heading_deg",
    "turned",
)
_TITLES = {
    "heading_deg": "heading (deg)",
    "top_m": "top",
    "distance_m": "distance",
    "cluster_length_m": "joined length",
}


def error_tables(datasets: Sequence[DatasetErrors]) -> list[TextTable]:
    """Return tables of box errors by view, 3D IoU, false positives and label fit; rows in the order of datasets."""
    names = _class_names(datasets)
    tables = [_box_table(datasets, name, main=True) for name in names]
    tables += [_reaching_table(datasets, names), _false_table(datasets, names), _background_table(datasets, names)]
    tables += [_false_rate_table(datasets, names), _fit_table(datasets, names)]
    return [table for table in tables if table.rows]


def group_tables(datasets: Sequence[DatasetErrors]) -> list[TextTable]:
    """Return tables of box errors by distance, occlusion, points and neighbors."""
    tables = [_box_table(datasets, name, main=False) for name in _class_names(datasets)]
    return [table for table in tables if table.rows]


def error_notes(datasets: Sequence[DatasetErrors]) -> list[str]:
    """Return the definitions needed to read the tables."""
    names = _class_names(datasets)
    overlaps = ", ".join(f"{name} {least_iou(name):g}" for name in names)
    return [
        "Errors are predicted minus label in metres: median ± half of its 95 % interval (half of what lies between the "
        "10th and the 90th percentile). Positive ends and sides are drawn too far out, a positive bottom too high, a "
        "positive range too far away. Near: the face towards the sensor. Turned: headings off by more than 90 degrees.",
        f"Found: BEV IoU at least {overlaps}. Errors are also those of badly placed boxes, from {LOCALIZATION_IOU:g} "
        "on. Below score: missed objects that a detection below the score covers well enough.",
        f"Clear: neither hidden nor truncated by more than {CLEAR_TRUNCATION:g}, as far as labels say, and within "
        f"{CLEAR_RANGE_M:g} m. End-on: less than {END_ON_DEG:g} degrees between axis and line of sight; side-on: more "
        f"than {SIDE_ON_DEG:g}. Objects count within the limits of KITTI's moderate, where labels "
        f"have them; {LARGELY_OCCLUDED} ones do not.",
        f"Intervals: bootstrap over blocks of {BLOCK_FRAMES} neighboring frames, within parts where there are any, and "
        f"over the parts; ±?: values of fewer than {MIN_BLOCKS} blocks have none.",
        *(f"{trait}: {meaning}" for trait, meaning in TRAITS.items()),
        *(f"{name}: {meaning}" for name, meaning in STATISTICS.items()),
    ]


def _class_names(datasets: Sequence[DatasetErrors]) -> list[str]:
    return list(dict.fromkeys(class_errors.class_name for data in datasets for class_errors in data.classes))


def _box_table(datasets: Sequence[DatasetErrors], name: str, *, main: bool) -> TextTable:
    classes = [(data.name, _class_of(data, name)) for data in datasets]
    groups = dict.fromkeys(group.group for _, errors in classes if errors is not None for group in errors.groups)
    rows = [
        (group, title, *_group_cells(group_errors))
        for group in groups
        if (group in MAIN_GROUPS) is main
        for title, errors in classes
        if (group_errors := _group_of(errors, group)) is not None
    ]
    titles = (_TITLES.get(column, column.replace("_", " ")) for column in _BOX_COLUMNS)
    columns = ("objects", "dataset", "n", "recall", "below score", "boxes", *titles)
    by = "view" if main else "distance, occlusion, points and the next object of the class"
    return TextTable(f"{name}: errors of boxes by {by}", columns, tuple(rows))


def _group_cells(group: GroupErrors) -> tuple[str, ...]:
    recall = _share(group.found / group.objects, group.recall_interval)
    spreads = [group.residuals[column] for column in _BOX_COLUMNS]
    digits = [1 if column == "heading_deg" else 2 for column in _BOX_COLUMNS]
    cells = [_spread(spread, places) for spread, places in zip(spreads, digits, strict=True)]
    return str(group.objects), recall, str(group.below_score), str(spreads[0].count), *cells


def _reaching_table(datasets: Sequence[DatasetErrors], names: Sequence[str]) -> TextTable:
    parts = (*CORRECTIONS, WITHOUT_MEDIANS)
    rows = [
        (
            name,
            data.name,
            str(errors.boxes),
            f"{errors.iou_3d:g}",
            *(f"{errors.reaching[part]:.2f}" for part in parts),
        )
        for name in names
        for data in datasets
        if (errors := _class_of(data, name)) is not None and errors.reaching
    ]
    title = (
        "Share of the boxes on objects that count whose 3D IoU reaches the minimum, as drawn and with parts corrected"
    )
    return TextTable(title, ("class", "dataset", "boxes", "3D IoU", *parts), tuple(rows))


def _false_table(datasets: Sequence[DatasetErrors], names: Sequence[str]) -> TextTable:
    rows = []
    for name in names:
        for data in datasets:
            if (class_errors := _class_of(data, name)) is None:
                continue
            false = class_errors.false
            on = ", ".join(f"{label} {count}" for label, count in false.labels.items()) or _NONE
            best = _NONE if class_errors.best_score is None else f"{class_errors.best_score:.2f}"
            kinds = [str(false.kinds[kind]) for kind in FALSE_KINDS]
            per_frame = _share(false.per_frame, false.per_frame_interval)
            rows.append((name, data.name, str(data.frames), f"{class_errors.score:.2f}", best, per_frame, *kinds, on))
    columns = ("class", "dataset", "frames", "score", "best F1 at", "false per frame", *FALSE_KINDS, "on labels of")
    return TextTable("False detections from the score on", columns, tuple(rows))


def _false_rate_table(datasets: Sequence[DatasetErrors], names: Sequence[str]) -> TextTable:
    rows = []
    for name in names:
        for data in datasets:
            class_errors = _class_of(data, name)
            rates = {} if class_errors is None else {rate.per_frame: rate for rate in class_errors.false_rates}
            if rates:
                cells = [
                    f"{rate.score:.2f} ({rate.recall:.2f})" if (rate := rates.get(limit)) else _NONE
                    for limit in FALSE_RATES
                ]
                rows.append((name, data.name, *cells))
    title = "Lowest score threshold with at most so many false detections per frame (recall at it)"
    return TextTable(title, ("class", "dataset", *(f"{rate:g} per frame" for rate in FALSE_RATES)), tuple(rows))


def _background_table(datasets: Sequence[DatasetErrors], names: Sequence[str]) -> TextTable:
    rows = []
    surroundings = ("distance_m", "points", "top_m", "reflectance", "cluster_length_m")
    for name in names:
        for data in datasets:
            class_errors = _class_of(data, name)
            if class_errors is None or not class_errors.false.traits:
                continue
            spreads = [class_errors.false.surroundings[key] for key in surroundings]
            cells = [
                _range(spread, 0 if key == "points" else 2) for key, spread in zip(surroundings, spreads, strict=True)
            ]
            traits = [f"{class_errors.false.traits[trait]:.2f}" for trait in (*TRAITS, "none")]
            rows.append((name, data.name, str(class_errors.false.kinds["background"]), *cells, *traits))
    titles = (_TITLES.get(key, key) for key in surroundings)
    title = "What stands where `background` is detected: median (10th to 90th percentile), and share with each trait"
    return TextTable(title, ("class", "dataset", "n", *titles, *TRAITS, "none"), tuple(rows))


def _fit_table(datasets: Sequence[DatasetErrors], names: Sequence[str]) -> TextTable:
    rows = []
    for name in names:
        classes = [_class_of(data, name) for data in datasets]
        for statistic in STATISTICS:
            spreads = [None if class_errors is None else class_errors.label_fit[statistic] for class_errors in classes]
            if any(spread is not None and spread.count for spread in spreads):
                rows.append((name, statistic, *map(_fit_cell, spreads)))
    title = (
        f"Labels against points, whole objects within {MAX_RANGE_M:g} m, no detector: "
        "median ± half of its 95 % interval (10th to 90th percentile), objects"
    )
    return TextTable(title, ("class", "statistic", *(data.name for data in datasets)), tuple(rows))


def _fit_cell(spread: Spread | None) -> str:
    if spread is None or spread.middle is None:
        return _NONE
    middle = _share(spread.middle, spread.interval)
    extent = "" if spread.low is None or spread.high is None else f" ({spread.low:z.2f} to {spread.high:z.2f})"
    return f"{middle}{extent}, {spread.count}"


def _class_of(data: DatasetErrors, name: str) -> ClassErrors | None:
    return next((class_errors for class_errors in data.classes if class_errors.class_name == name), None)


def _group_of(class_errors: ClassErrors | None, group: str) -> GroupErrors | None:
    return None if class_errors is None else next((item for item in class_errors.groups if item.group == group), None)


def _spread(spread: Spread, digits: int) -> str:
    if spread.middle is None:
        return _NONE
    if spread.low is None or spread.high is None:
        return _share(spread.middle, spread.interval)
    half = (spread.high - spread.low) / 2
    return f"{spread.middle:+z.{digits}f} ±{_half(spread.interval, digits)} ({half:.{digits}f})"


def _range(spread: Spread, digits: int) -> str:
    if spread.middle is None or spread.low is None or spread.high is None:
        return _NONE
    middle, low, high = (f"{value:z.{digits}f}" for value in (spread.middle, spread.low, spread.high))
    return f"{middle} ({low} to {high})"


def _share(value: float | None, interval: Interval) -> str:
    return _NONE if value is None else f"{value:.2f} ±{_half(interval)}"


def _half(interval: Interval, digits: int = 2) -> str:
    return "?" if interval is None else f"{(interval[1] - interval[0]) / 2:.{digits}f}"
