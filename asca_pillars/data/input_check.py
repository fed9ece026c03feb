"""How far a scan is from those of the training, with the option that mends it.

A wrong reflectance scale, sensor height or axis ruins detection without any error; here it becomes a sentence.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from asca_pillars.data.expected_input import ExpectedInput
from asca_pillars.data.frame_check import doubt_frame, ground_z_m
from asca_pillars.data.mounting import Mounting
from asca_pillars.geometry.frame_report import ScanCounts

OUTSIDE_SHARE = 0.95
SAMPLE_POINTS = 8_192  # as good as all of them for a mean and a percentile, at a tenth of a millisecond
_FRAME_STEP = 2  # of the sample; angles and ranges take longer

TOLERANCE_M = 0.5
"""A ground further than this from where a detector expects it is another sensor height, not another road."""

_SCALES = (100.0, 255.0, 65535.0)


class InputWarning(NamedTuple):
    """One way in which a scan is far from the training scans; `about` names the way, `text` is for people."""

    about: str
    text: str


def check_input(
    points: NDArray[np.float32], counts: ScanCounts, expected: ExpectedInput, mounting: Mounting | None = None
) -> list[InputWarning]:
    """Compare a scan with the training scans.

    Args:
        points: (N, 4) finite x, y, z in metres, model's frame, and reflectance.
        counts: what became of them on the detector's grid.
        expected: of the training scans.
        mounting: by which they came into that frame.
    """
    mounting = mounting or Mounting()
    fewest, most = expected.points_per_scan
    if len(points) < fewest / 10:
        text = f"{len(points)} points, the training scans had {fewest} to {most}"
        return [InputWarning("points", text)]  # too few to say anything else
    # Column by column in memory, which is how it is read: NumPy is slow along rows of four.
    sample = np.ascontiguousarray(points[:: max(1, len(points) // SAMPLE_POINTS)].T).T
    ground = ground_z_m(sample)
    doubt = doubt_frame(sample[::_FRAME_STEP], ground)
    warnings = [_reflectance_warning(sample[:, 3], expected)]
    if doubt is not None:
        warnings.append(InputWarning(doubt.about, f"{doubt.text}: {_axes_remedy(doubt.axes, mounting)}"))
    if doubt is None or doubt.about not in ("upside down", "tilt"):  # then the height means nothing
        warnings.append(_height_warning(ground, expected, mounting))
    if counts.points_outside > OUTSIDE_SHARE * counts.points and doubt is None:
        share = 100 * counts.points_outside / counts.points
        text = (
            f"{share:.1f} % of the points lie outside the grid, where x is forward, y left, z up, in metres: "
            "state other axes (--axes)"
        )
        warnings.append(InputWarning("range", text))
    return [warning for warning in warnings if warning]


def _reflectance_warning(reflectance: NDArray[np.float32], expected: ExpectedInput) -> InputWarning | None:
    low, high = expected.reflectance_mean
    largest, mean = float(reflectance.max()), float(reflectance.mean(dtype=np.float64))
    if largest > 1.5:
        scale = next((scale for scale in _SCALES if largest <= scale), _SCALES[-1])
        text = (
            f"reflectance reaches {largest:.4g}, the model was trained on 0..1: divide it by {scale:g} "
            f"(--reflectance-scale {scale:g} for files)"
        )
        return InputWarning("reflectance", text)
    if not low / 3 <= mean <= high * 3:
        text = (
            f"mean reflectance is {mean:.3g}, in training it was {low:.3g} to {high:.3g}: rescale it to 0..1 "
            "(--reflectance-scale for files)"
        )
        return InputWarning("reflectance", text)
    return None


def _height_warning(ground: float | None, expected: ExpectedInput, mounting: Mounting) -> InputWarning | None:
    if ground is None or expected.ground_z_m is None:
        return None
    low, high = expected.ground_z_m
    if low - TOLERANCE_M <= ground <= high + TOLERANCE_M:
        return None
    lifted_m = 0.0
    if mounting.sensor_height_m is not None and expected.sensor_height_m is not None:
        lifted_m = mounting.sensor_height_m - expected.sensor_height_m
    height_m = lifted_m - ground + 0.0  # no -0
    text = (
        f"the ground near the sensor lies at z = {ground:.2f} m, in training at {low:.2f} to {high:.2f} m: "
        f"state the height above the ground (--sensor-height {height_m:.2f} or auto)"
    )
    return InputWarning("height", text)


def _axes_remedy(axes: str | None, mounting: Mounting) -> str:
    if axes is None:
        return "state how the sensor is tilted (--pose)"
    if not mounting.level.is_identity:
        return "check the axes or the pose that were given"
    return f"if so, state the axes (--axes {axes})"
