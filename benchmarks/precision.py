"""Effect of lower precision on given scans: raw head maps and final boxes, against float32 on stock onnxruntime.

    python -m benchmarks.precision scans/                # a scan or a folder of them; default: the sample

For the effect on AP run `asca eval` on both bundles; this shows where the difference arises.
"""

import logging
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import numpy as np
import typer
from numpy.typing import NDArray
from rich.console import Console
from rich.progress import track
from rich.table import Table

from asca_deploy import Detector, sample_scan_path
from asca_deploy.benchmark.box_differences import box_difference
from asca_deploy.providers import Precision, Provider
from asca_export.parity import COMPARED_ANCHORS
from asca_pillars.base.errors import ProviderError
from asca_pillars.cli.run_command import run_command
from asca_pillars.detection.decode import HeadMaps
from asca_pillars.scans.find_scans import find_scans
from asca_pillars.scans.scan_reader import read_scan

ROWS = (
    "class logits of the best anchors, rms",
    "class logits, rms",
    "class logits, largest",
    "box residuals of the best anchors, rms",
    "box residuals, largest",
    "boxes in both",
    "boxes in one only",
    "largest difference of a box, m",
    "largest difference of a score",
)


def main(
    scans: Annotated[Path | None, typer.Argument(help="A scan or a folder of them. Default: the sample.")] = None,
    reference: Annotated[str, typer.Option(help="Float32 bundle: a folder or one that ships.")] = "default_float32",
    int8: Annotated[str, typer.Option(help="The 8-bit one made from it.")] = "default",
) -> None:
    """Print one row for each way to run the network with fewer digits."""
    console = Console(markup=False)
    logging.getLogger("asca_pillars").setLevel(logging.ERROR)  # any scan may be given
    points = [read_scan(path).points for path in find_scans(sample_scan_path() if scans is None else scans)]
    expected = Detector(reference)
    table = Table("", title=f"{len(points)} scan(s), against {reference} on cpu in float32")
    columns = []
    configurations: tuple[tuple[str, Provider, Precision], ...] = (
        (int8, "cpu", "float32"),
        (int8, "openvino", "float32"),
        (reference, "openvino", "float32"),
        (reference, "openvino", "reduced"),
    )
    for bundle, provider, precision in configurations:
        name = f"{Path(bundle).name}, {provider} {precision}"
        try:
            detector = Detector(bundle, provider=provider, precision=precision)
        except ProviderError as error:
            console.print(f"{name}: {error}", soft_wrap=True)
            continue
        table.add_column(name, justify="right")
        columns.append(_column(expected, detector, points, console))
    for row in zip(ROWS, *columns, strict=True):
        table.add_row(*row)
    console.print(table)


def _column(
    expected: Detector, detector: Detector, scans: Sequence[NDArray[np.float32]], console: Console
) -> list[str]:
    """Return the values of ROWS."""
    errors = []
    for points in track(scans, "Comparing", console=console, transient=True):
        ours, theirs = _maps(expected, points), _maps(detector, points)
        anchors = _best_anchors(ours.scores)
        logits = np.abs(ours.scores - theirs.scores)
        residuals = np.abs(ours.boxes - theirs.boxes).reshape(len(logits), 7, *logits.shape[1:])
        at_best = residuals[anchors[0], :, anchors[1], anchors[2]]
        means = (np.square(each).mean() for each in (logits[anchors], logits, at_best))
        errors.append((*means, logits.max(), residuals.max()))
    *squares, worst_logit, worst_residual = np.array(errors).T
    best, everywhere, residual = (float(np.sqrt(square.mean())) for square in squares)
    boxes = box_difference([expected(points) for points in scans], [detector(points) for points in scans])
    return [
        f"{best:.4f}",
        f"{everywhere:.4f}",
        f"{worst_logit.max():.2g}",
        f"{residual:.4f}",
        f"{worst_residual.max():.2g}",
        str(boxes.pairs),
        str(boxes.lone),
        f"{boxes.center_size_m:.3f}",
        f"{boxes.score:.3f}",
    ]


def _maps(detector: Detector, points: NDArray[np.float32]) -> HeadMaps[NDArray[np.float32]]:
    pipeline = detector.pipeline
    return pipeline.infer(pipeline.prepare(points, []), []).maps


def _best_anchors(logits: NDArray[np.float32]) -> tuple[NDArray[np.int64], ...]:
    """Return indices (anchor, row, column) of the best anchors of each class; two anchors belong to one class."""
    by_class = logits.reshape(len(logits) // 2, -1)
    best = np.argpartition(-by_class, COMPARED_ANCHORS, axis=1)[:, :COMPARED_ANCHORS]
    flat = best + np.arange(len(best))[:, None] * by_class.shape[1]
    return tuple(np.unravel_index(flat.reshape(-1), logits.shape))


if __name__ == "__main__":
    run_command(main)
