"""The picture of the precision-recall curves."""

from pathlib import Path

import cv2
import numpy as np

from asca_pillars.evaluation.curves import write_curves
from asca_pillars.evaluation.kitti.average_precision import Curve, KittiResults


def results(precision: list[float]) -> KittiResults:
    padded = np.pad(np.array(precision), (0, 41 - len(precision)))
    none = np.zeros(0)
    counts = none.astype(np.int64)
    curve = Curve("Car", "3d", "moderate", padded, 50, 20, none, counts, counts, counts)
    return KittiResults({("Car", "3d", "moderate"): curve}, ("Car", "Pedestrian"), 1)


def blue(path: Path) -> np.ndarray:
    """Columns of the pixels in the color of the moderate difficulty, in the left half and below the middle."""
    image = np.asarray(cv2.imread(str(path)))
    assert image.shape[1] > 700 and image.shape[0] > 600
    lower_left = image[image.shape[0] // 2 :, : image.shape[1] // 2].astype(int)
    return np.nonzero(np.abs(lower_left - (178, 114, 0)).max(axis=-1) < 40)[1]


def test_a_curve_ends_at_the_highest_recall_reached_and_may_be_empty(tmp_path: Path) -> None:
    """Two curves of precision 1 that reach recall 0.25 and 0.75: the second one is three times as long."""
    for name, samples in (("short", 11), ("long", 31)):
        write_curves(tmp_path / f"{name}.png", results([1.0] * samples), name)
    short, long = blue(tmp_path / "short.png"), blue(tmp_path / "long.png")
    assert len(short) > 50 and len(long) > 50
    assert np.ptp(long) > 1.5 * np.ptp(short)
    write_curves(tmp_path / "empty.png", results([]), "a title that is far too long for the picture " * 9)
    assert np.asarray(cv2.imread(str(tmp_path / "empty.png"))) is not None
