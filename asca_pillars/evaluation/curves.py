"""Plot of precision-recall curves; the only part of the evaluation that needs matplotlib."""

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from asca_pillars.base.files import atomic_path
from asca_pillars.base.own_files import PICTURE_SOFTWARE
from asca_pillars.evaluation.kitti.average_precision import DIFFICULTIES, Curve, KittiResults

if TYPE_CHECKING:
    from matplotlib.axes import Axes

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
