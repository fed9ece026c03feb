"""Plots of the comparison; the only part of the report that needs matplotlib."""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from asca_pillars.base.files import atomic_path
from asca_pillars.base.own_files import PICTURE_SOFTWARE
from asca_pillars.sim.report.comparison import BARRED_RANGES_M, RATIO_BAR, Comparison, Measured, coarse
from asca_pillars.sim.report.reference import (
    BAND_M,
    BANDS,
    CAR_FIT_RANGE_M,
    CLASSES,
    NEAR_CARS_M,
    SECTORS,
    Band,
    Sensor,
)
from asca_pillars.sim.report.scan_statistics import MATERIALS

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_REAL: dict[str, Any] = {"color": "#0072B2", "label": "KITTI"}
_OURS: dict[str, Any] = {"color": "#D55E00", "label": "this set"}
_COARSE_EDGES = np.concatenate([[-0.05], np.arange(21) * 0.05])


def write_plots(folder: Path, comparison: Comparison, measured: Measured, sensor: Sensor) -> tuple[str, ...]:
    """Draw real and simulated statistics over each other; the names of the PNG files in `folder`.

    Raises:
        ModuleNotFoundError: matplotlib is not installed.
    """
    pictures = {"reflectance": _reflectance(comparison), "cars": _cars(comparison, measured)}
    if comparison.simulated.scan.points is not None:
        pictures["scans"] = _scans(comparison, sensor)
    pictures["labels"] = _labels(comparison)
    return tuple(save_figure(folder / f"{name}.png", figure) for name, figure in pictures.items())


def new_figure(rows: int, columns: int, width: float, height: float) -> tuple["Figure", list["Axes"]]:
    """Return a figure of `rows` by `columns` plots of `width` by `height` inches, and these plots."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width * columns, height * rows), layout="tight", dpi=100)
    return figure, list(figure.subplots(rows, columns, squeeze=False).flat)


def save_figure(path: Path, figure: "Figure") -> str:
    """Write a figure as PNG; its file name."""
    # No pyplot and no backend: a Figure object has no global state and needs no display.
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    with atomic_path(path) as temporary:
        FigureCanvasAgg(figure).print_png(temporary, metadata={"Software": PICTURE_SOFTWARE})
    return path.name


def _reflectance(comparison: Comparison) -> "Figure":
    """Plot the fractions in the 21 bins, for each material; exactly 0 is the first."""
    real, simulated = comparison.real.scan.reflectance, comparison.simulated.scan.reflectance
    rows = {row.name: row for row in comparison.rows}
    figure, plots = new_figure(2, 4, 4.0, 3.0)
    for plot, name in zip(plots, MATERIALS, strict=False):
        for side, style in ((real, _REAL), (simulated, _OURS)):
            if name in side:
                plot.stairs(_shares(coarse(side[name].counts)), _COARSE_EDGES, linewidth=1.6, **style)
        row = rows.get(f"reflectance: {name}")
        chance = "" if row is None or row.noise is None else f", by chance {row.noise:.3f}"
        plot.set_title(name if row is None else f"{name}: JS {row.value:.3f}{chance}", fontsize=9)
        plot.axvline(0, color="gray", linewidth=0.6)
    for plot in plots[len(MATERIALS) :]:
        plot.set_axis_off()
    _finish(plots, "share of points")
    figure.suptitle("Reflectance (left of the line: exactly 0)")
    return figure


def _cars(comparison: Comparison, measured: Measured) -> "Figure":
    """Plot points of unoccluded cars over distance, the fits, and the tolerances about KITTI's."""
    figure, (plot,) = new_figure(1, 1, 7.0, 5.0)
    cars = np.concatenate([record.cars for record in measured.records])
    plot.plot(cars[:, 0], cars[:, 1], ".", color=_OURS["color"], alpha=0.4, label="a car of this set")
    for side, style in ((comparison.real.scan, _REAL), (comparison.simulated.scan, _OURS)):
        for fit, end_m, line in ((side.car_fit, CAR_FIT_RANGE_M[1], ":"), (side.near_car_fit, NEAR_CARS_M[1], "-")):
            if fit is None:
                continue
            ranges_m = np.geomspace(8.0, end_m, 60)
            points = np.array([fit.points_at(range_m) for range_m in ranges_m])
            factor = np.exp([fit.error_at(range_m) for range_m in ranges_m])
            label = f"{style['label']}, fitted to {fit.cars} cars up to {end_m:.0f} m"
            plot.plot(ranges_m, points, line, color=style["color"], label=label)
            plot.fill_between(ranges_m, points / factor, points * factor, color=style["color"], alpha=0.12)
    if (fit := comparison.real.scan.near_car_fit) is not None:
        at = np.array([fit.points_at(range_m) for range_m in BARRED_RANGES_M])
        plot.errorbar(
            BARRED_RANGES_M, at, RATIO_BAR * at, fmt="none", color="black", capsize=4, label="bars, near cars"
        )
    plot.set(xscale="log", yscale="log", xlabel="horizontal distance (m)", ylim=(0.8, None))
    plot.set_xticks((10, 20, 30, 40, 50, 60, 70), labels=("10", "20", "30", "40", "50", "60", "70"))
    plot.set_xticks((), minor=True)
    plot.set_title("Points of unoccluded, untruncated cars")
    _finish([plot], "points")
    return figure


def _scans(comparison: Comparison, sensor: Sensor) -> "Figure":
    """Plot the distribution of the returns of whole scans."""
    real, simulated = comparison.real.scan, comparison.simulated.scan
    figure, (rings, sectors, ranges, heights, reflectances, last) = new_figure(2, 3, 5.0, 3.4)
    for side, style in ((real, _REAL), (simulated, _OURS)):
        if side.points_per_ring is not None:
            rings.plot(side.points_per_ring, **style)
        if side.sector_points is not None:
            sectors.stairs(side.sector_points, np.arange(SECTORS + 1) * (360 / SECTORS), **style)
        if side.range_points is not None:
            ranges.stairs(side.range_points, **style)
        if side.ground_z_m is not None and side.ground_reflectance is not None:
            _draw_bands(heights, side.ground_z_m, style)
            _draw_bands(reflectances, side.ground_reflectance, style)
    rings.set(title="Points per ring", xlabel="ring from the top", ylim=(0, None))
    firings = sensor.firings_per_ring
    scales = (lambda points: np.divide(points, firings), lambda share: np.multiply(share, firings))
    share = rings.secondary_yaxis("right", functions=scales)
    share.set_ylabel("share of firings that return")
    sectors.set(
        title="Points per 5 degrees", xlabel="azimuth from ahead, to the left (degrees)", xticks=range(0, 361, 60)
    )
    sectors.set_ylim(0, None)
    ranges.set(title="Points per metre of range", xlabel="slant range (m)", yscale="log", ylim=(10, None))
    heights.set(title="Height of the ground, mean and deviation", xlabel="slant range (m)", ylabel="m")
    reflectances.set(title="Reflectance of the ground, mean and deviation", xlabel="slant range (m)")
    last.set_axis_off()
    _finish([rings, sectors, ranges, heights, reflectances], "")
    return figure


def _labels(comparison: Comparison) -> "Figure":
    """Plot distributions of the labels, a row for each class."""
    figure, plots = new_figure(len(CLASSES), 5, 3.7, 2.9)
    for index, name in enumerate(CLASSES):
        far, yaw, number, hidden, sizes = plots[5 * index : 5 * index + 5]
        for side, style, offset in ((comparison.real, _REAL, -0.15), (comparison.simulated, _OURS, 0.15)):
            if (labels := side.labels.get(name)) is None:
                continue
            far.stairs(_shares(labels.range_counts), np.arange(len(labels.range_counts) + 1) * 5, **style)
            yaw.stairs(_shares(labels.yaw_counts), np.linspace(-180, 180, len(labels.yaw_counts) + 1), **style)
            number.stairs(_shares(labels.per_frame), np.arange(len(labels.per_frame) + 1) - 0.5, **style)
            hidden.bar(np.arange(4) + offset, _shares(labels.occlusion), 0.3, **style)
            spreads = (labels.height_m, labels.width_m, labels.length_m)
            places = np.arange(3) + offset
            low, quarter, median, three, high = np.array([spread.percentiles for spread in spreads]).T
            sizes.vlines(places, low, high, color=style["color"])
            sizes.bar(places, three - quarter, 0.2, quarter, alpha=0.5, **style)
            sizes.plot(places, median, "_", color=style["color"], markersize=12)
        far.set(title=f"{name}: distance (m)", xlim=(0, 90))
        yaw.set(title=f"{name}: heading (degrees)", xticks=(-180, -90, 0, 90, 180))
        number.set(title=f"{name}: number per frame", xlim=(-0.5, 12.5))
        hidden.set(title=f"{name}: occlusion state", xticks=range(4))
        sizes.set(title=f"{name}: sizes (m)", xticks=range(3), xticklabels=("height", "width", "length"))
    _finish(plots, "")
    return figure


def _draw_bands(plot: "Axes", bands: Sequence[Band | None], style: dict[str, Any]) -> None:
    middles = (np.arange(BANDS) + 0.5) * BAND_M
    known = np.array([band is not None for band in bands])
    mean, std = np.array([(band.mean, band.std) for band in bands if band is not None]).T
    plot.plot(middles[known], mean, marker="o", markersize=3, **style)
    plot.fill_between(middles[known], mean - std, mean + std, color=style["color"], alpha=0.15)


def _finish(plots: Sequence["Axes"], y_label: str) -> None:
    for plot in plots:
        plot.grid(alpha=0.3)
        if y_label:
            plot.set_ylabel(y_label)
        if plot.get_legend_handles_labels()[0]:
            plot.legend(fontsize=8)


def _shares(counts: ArrayLike) -> NDArray[np.float64]:
    values = np.asarray(counts, np.float64)
    return np.asarray(values / values.sum())
