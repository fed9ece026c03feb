"""Comparison of a folder's statistics with KITTI's, row by row, each with a tolerance."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from asca_pillars.base.errors import DatasetError
from asca_pillars.base.progress import SILENT, Reporter
from asca_pillars.data.kitti import KittiSplit
from asca_pillars.sim.report.reference import (
    BAND_M,
    CLASSES,
    PERCENTILES,
    REFLECTANCES,
    Band,
    ScanStatistics,
    Statistics,
    kitti_reference,
)
from asca_pillars.sim.report.scan_statistics import (
    MATERIALS,
    OBJECTS,
    ScanRecord,
    fits_of,
    label_statistics,
    measure_scan,
    scan_statistics,
    unit_histograms,
)

_DRAWS = 200
_GROUP = 5


def jensen_shannon(first: ArrayLike, second: ArrayLike) -> NDArray[np.float64]:
    """Return the Jensen-Shannon distance (...) of histograms (..., B) of any positive sums: 0 if equal, 1 if disjoint.

    The square root of the divergence in bits, so that it is a metric of at most 1; `jensenshannon` of SciPy gives
    the same with `base=2`, and 0.83 of it with its default, natural logarithms.
    """
    p, q = np.asarray(first, np.float64), np.asarray(second, np.float64)
    p, q = p / p.sum(axis=-1, keepdims=True), q / q.sum(axis=-1, keepdims=True)
    middle = (p + q) / 2
    with np.errstate(divide="ignore", invalid="ignore"):
        terms = np.where(p > 0, p * np.log2(p / middle), 0.0) + np.where(q > 0, q * np.log2(q / middle), 0.0)
    return np.asarray(np.sqrt(np.maximum(terms.sum(axis=-1) / 2, 0.0)))


def coarse(counts: ArrayLike) -> NDArray[np.float64]:
    """Group reflectances (..., 100) in steps of 0.01 to (..., 21): exactly 0, then 20 bins of 0.05.

    A real histogram of a few hundred points has most of its hundred bins empty or nearly so: compared bin by bin with
    any other it would be far away. Reflectances reported as 0 are a separate bin, not dark ones.
    """
    fine = np.asarray(counts, np.float64)
    groups = fine.reshape(*fine.shape[:-1], -1, _GROUP).sum(axis=-1)
    groups[..., 0] -= fine[..., 0]
    return np.concatenate([fine[..., :1], groups], axis=-1)


def noise_of_points(counts: ArrayLike, size: int) -> float:
    """Return the mean distance of a histogram (B,) from `size` points sampled from it."""
    shares = np.asarray(counts, np.float64) / np.sum(counts)
    draws = np.random.default_rng(0).multinomial(size, shares, _DRAWS)
    return float(jensen_shannon(draws, shares).mean())


def noise_of_units(stack: NDArray[np.float64], units: int) -> float:
    """Return the mean distance of the sum of histograms (U, B) from that of `units` of them sampled at random.

    The points of one object share its paint or its clothes: a few objects differ from many by more than as many
    independent points would.
    """
    rng = np.random.default_rng(0)
    draws = np.stack([stack[rng.integers(len(stack), size=units)].sum(axis=0) for _ in range(_DRAWS)])
    return float(jensen_shannon(draws, stack.sum(axis=0)).mean())


MAX_SCANS = 300
"""Scans that are read, enough for means to within a percent. Labels are cheap and read of every frame."""


@dataclass(frozen=True)
class Measured:
    """Statistics of a data set, and the contribution of each scan: their spread gives the noise."""

    statistics: Statistics
    records: Sequence[ScanRecord]


def measure(root: str | Path, *, max_scans: int = MAX_SCANS, reporter: Reporter = SILENT) -> Measured:
    """Measure the frames of `root`/training, at most `max_scans` of their scans, evenly spaced.

    Raises:
        DatasetError: there is no scan, or a frame without labels or calibration.
        ScanError: a damaged scan.
    """
    split = KittiSplit(root)
    frame_ids = split.frame_ids
    if not any(split.label_path(frame_id).is_file() for frame_id in frame_ids):
        raise DatasetError(f"{split.folder / 'label_2'}: no labels there; the comparison needs them for objects")
    labels, dont_care = label_statistics(split, frame_ids)
    chosen = np.linspace(0, len(frame_ids) - 1, min(max_scans, len(frame_ids))).round().astype(int)
    sensor = kitti_reference().sensor
    records = [measure_scan(split, frame_ids[index], sensor) for index in reporter.track(chosen, "Measuring")]
    fits = fits_of({name: np.concatenate([record.fits[name] for record in records]) for name in CLASSES}, str(root))
    return Measured(Statistics(str(root), scan_statistics(records), len(frame_ids), labels, dont_care, fits), records)


RATIO_BAR = 0.15
DISTANCE_BAR = 0.15
MIN_DRIVES = 3  # drives of KITTI with a statistic, needed for its tolerance
MIN_FIT_BAR = 0.03
BARRED_RANGES_M = (10, 20, 30, 40)
CAR_RANGES_M = (*BARRED_RANGES_M, 50)

_MEANS = {
    "points per scan": "points",
    "points in camera view": "camera_points",
    "ground share": "ground_share",
    "ground share in view": "camera_ground_share",
}
_PLACES = {
    "points per ring": "points_per_ring",
    "azimuths, bins of 5 degrees": "sector_points",
    "ranges, bins of 1 m": "range_points",
}
_SHARES = {"heads as we do": "yaw_same", "comes towards us": "yaw_oncoming", "heads across": "yaw_across"}
_HISTOGRAMS = {
    "number per frame": "per_frame",
    "distances, bins of 5 m": "range_counts",
    "headings, bins of 15 degrees": "yaw_counts",
    "occlusion states": "occlusion",
    "truncation groups": "truncation",
}

Measure = Literal["ratio", "difference", "distance"]


@dataclass(frozen=True)
class Row:
    """Compared quantity.

    Attributes:
        group: heading of the row.
        real, simulated: the two values; means of histograms, where meaningful.
        measure: meaning of `value`: simulated / real, simulated - real, or the Jensen-Shannon distance.
        bar: tolerance: largest deviation of a ratio from 1 or a difference from 0, or largest distance; None if the row
            is for information.
        noise: noise, where known: the standard error of a ratio or a difference; the expected distance of as few
            objects (or scans) as for the real reflectances, or of as few labels as in this set.
        noise_of_points: the expected distance of as many independent points as there are real reflectances.
    """

    group: str
    name: str
    real: float | None
    simulated: float | None
    measure: Measure
    value: float
    bar: float | None = None
    noise: float | None = None
    noise_of_points: float | None = None

    @property
    def within(self) -> bool | None:
        """True if the value is within the tolerance; None without one."""
        if self.bar is None:
            return None
        return self.value < self.bar if self.measure == "distance" else self.away <= self.bar

    @property
    def away(self) -> float:
        """Distance of the value from that of two equal sets."""
        return abs(self.value - 1) if self.measure == "ratio" else abs(self.value)

    @property
    def within_noise(self) -> bool:
        """True if the tolerance is exceeded by no more than the noise of the real data."""
        return self.within is False and self.noise is not None and self.away <= self.noise


@dataclass(frozen=True)
class Comparison:
    """Rows, and sentences about rows that could not be computed."""

    real: Statistics
    simulated: Statistics
    rows: tuple[Row, ...]
    skipped: tuple[str, ...]

    @property
    def missed(self) -> tuple[Row, ...]:
        """Rows outside their tolerance."""
        return tuple(row for row in self.rows if row.within is False)


def compare(measured: Measured, real: Statistics) -> Comparison:
    """Return all rows for which both sides have the numbers."""
    simulated = measured.statistics
    rows = [
        *_scan_rows(real.scan, simulated.scan),
        *_car_rows(real.scan, simulated.scan),
        *_reflectance_rows(real.scan, measured),
        *_band_rows(real.scan, simulated.scan),
        *_fit_rows(real, simulated),
        *(row for name in real.labels if name in simulated.labels for row in _label_rows(name, real, simulated)),
        _ratio("labels", "DontCare per frame", real.dont_care_per_frame, simulated.dont_care_per_frame),
    ]
    return Comparison(real, simulated, tuple(rows), tuple(_skipped(real, simulated)))


def _scan_rows(real: ScanStatistics, simulated: ScanStatistics) -> Iterator[Row]:
    for name, field in _MEANS.items():
        first, second = getattr(real, field), getattr(simulated, field)
        if first is not None and second is not None:
            error = np.hypot(first.std / np.sqrt(real.scans), second.std / np.sqrt(simulated.scans)) / first.mean
            yield _ratio("scans", name, first.mean, second.mean, RATIO_BAR, float(error))
    for name, field in _PLACES.items():
        first, second = getattr(real, field), getattr(simulated, field)
        if first is not None and second is not None and len(first) == len(second):
            yield Row("scans", name, None, None, "distance", float(jensen_shannon(first, second)))


def _car_rows(real: ScanStatistics, simulated: ScanStatistics) -> Iterator[Row]:
    for name, field in (("points of a car", "car_fit"), ("of near cars alone", "near_car_fit")):
        first, second = getattr(real, field), getattr(simulated, field)
        if first is None or second is None:
            continue
        for range_m in CAR_RANGES_M:
            bar = RATIO_BAR if range_m in BARRED_RANGES_M else None
            points = first.points_at(range_m), second.points_at(range_m)
            error = points[1] / points[0] * np.hypot(first.error_at(range_m), second.error_at(range_m))
            yield _ratio("points per car", f"{name} at {range_m} m", *points, bar, float(error))


def _reflectance_rows(real: ScanStatistics, measured: Measured) -> Iterator[Row]:
    levels = np.arange(REFLECTANCES) / REFLECTANCES
    for name in MATERIALS:
        first, second = real.reflectance.get(name), measured.statistics.scan.reflectance.get(name)
        if first is None or second is None:
            continue
        p, q = np.array(first.counts), np.array(second.counts)
        units = coarse(unit_histograms(measured.records, name))
        noise = (
            noise_of_units(units, first.units) if len(units) >= first.units else None,
            noise_of_points(coarse(q), round(p.sum())),
        )
        means = float(levels @ p / p.sum()), float(levels @ q / q.sum())
        distance = float(jensen_shannon(coarse(p), coarse(q)))
        yield Row("reflectance", f"reflectance: {name}", *means, "distance", distance, DISTANCE_BAR, *noise)
        yield Row("reflectance", f"{name}, bins of 0.01", None, None, "distance", float(jensen_shannon(p, q)))
        yield _ratio("reflectance", f"{name}, share of 0", float(p[0] / p.sum()), float(q[0] / q.sum()))


def _band_rows(real: ScanStatistics, simulated: ScanStatistics) -> Iterator[Row]:
    z, reflectance = real.ground_z_m, real.ground_reflectance
    if z is None or reflectance is None or simulated.ground_z_m is None or simulated.ground_reflectance is None:
        return
    yield from _by_range("ground", "mean height (m)", z, simulated.ground_z_m)
    for band, (first, second) in enumerate(zip(reflectance, simulated.ground_reflectance, strict=True)):
        if first and second:
            yield _ratio("ground", f"mean reflectance, {_range_name(band)}", first.mean, second.mean)


def _fit_rows(real: Statistics, simulated: Statistics) -> Iterator[Row]:
    """Yield rows of the median over the drives, with the drives' own spread as the tolerance."""
    for name, drives in real.label_fit.items():
        if name not in simulated.label_fit:
            continue
        (fit,) = simulated.label_fit[name]
        middle = float(np.median([drive.middle for drive in drives]))
        spread = max(abs(drive.middle - middle) for drive in drives)
        # A normal distribution has four fifths of its mass within 1.28 deviations; medians scatter by 1.25 / sqrt(n).
        noise = 1.25 * (fit.high - fit.low) / 2.56 / np.sqrt(fit.objects)
        bar = max(spread, MIN_FIT_BAR) if len(drives) >= MIN_DRIVES else None
        group = "where points lie in their labels (m, shares)"
        yield Row(group, name, middle, fit.middle, "difference", fit.middle - middle, bar, float(noise))


def _label_rows(name: str, real: Statistics, simulated: Statistics) -> Iterator[Row]:
    first, second = real.labels[name], simulated.labels[name]
    yield _ratio(name, "per frame", first.count / real.frames, second.count / simulated.frames)
    for size in ("height_m", "width_m", "length_m"):
        of_first, of_second = getattr(first, size), getattr(second, size)
        yield _ratio(name, f"{size.removesuffix('_m')}, mean (m)", of_first.mean, of_second.mean)
        yield _ratio(name, f"{size.removesuffix('_m')}, deviation (m)", of_first.std, of_second.std)
    for title, field in _SHARES.items():
        yield _ratio(name, title, getattr(first, field), getattr(second, field))
    for title, counts in (("occlusion", "occlusion"), ("truncation", "truncation")):
        p, q = np.array(getattr(first, counts)), np.array(getattr(second, counts))
        yield _ratio(name, f"{title}: share of none", p[0] / p.sum(), q[0] / q.sum())
    for title, field in _HISTOGRAMS.items():
        p, q = getattr(first, field), getattr(second, field)
        noise = noise_of_points(p, sum(q))
        yield Row(name, title, None, None, "distance", float(jensen_shannon(p, q)), None, noise)
    for index in (0, 2, 4):
        place = first.left_m.percentiles[index], second.left_m.percentiles[index]
        yield _difference(name, f"to the left (m), {PERCENTILES[index]} %", *place)
    yield from _by_range(name, "bottom (m)", first.bottom_z_m, second.bottom_z_m)


def _by_range(
    group: str, what: str, real: tuple[Band | None, ...], simulated: tuple[Band | None, ...]
) -> Iterator[Row]:
    for band, (first, second) in enumerate(zip(real, simulated, strict=True)):
        if first and second:
            yield _difference(group, f"{what}, {_range_name(band)}", first.mean, second.mean)


def _range_name(band: int) -> str:
    return f"{band * BAND_M:.0f}-{(band + 1) * BAND_M:.0f} m"


def _ratio(
    group: str, name: str, real: float, simulated: float, bar: float | None = None, noise: float | None = None
) -> Row:
    return Row(group, name, real, simulated, "ratio", simulated / real if real else float("nan"), bar, noise)


def _difference(group: str, name: str, real: float, simulated: float) -> Row:
    return Row(group, name, real, simulated, "difference", simulated - real)


def _skipped(real: Statistics, made: Statistics) -> Iterator[str]:
    if made.scan.points is None:
        yield (
            "the scans hold only what the camera sees: no points per scan and ring, ranges, ground by range, "
            "reflectances of all, ground and non_ground returns; simulate with --view full to compare them"
        )
    elif made.scan.points_per_ring is None or len(made.scan.points_per_ring) != len(real.scan.points_per_ring or ()):
        yield "the scans have another number of rings than KITTI's: no points per ring"
    if made.scan.car_fit is None:
        yield "too few unoccluded, untruncated cars between 12 and 70 m: no points per car"
    for name in sorted(set(real.labels) - set(made.labels)):
        yield f"no {name} is labelled"
    for name in sorted(set(real.scan.reflectance) & set(OBJECTS) - set(made.scan.reflectance)):
        yield f"no returns of a {name}: no reflectance"
