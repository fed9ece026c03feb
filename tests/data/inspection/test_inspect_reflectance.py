"""What `asca inspect` says of reflectances: of those that reading changes, and only of them."""

import re
from pathlib import Path

import numpy as np
import pytest

from tests.data.inspection.inspected_data import change_scans, found


@pytest.mark.parametrize(
    ("scale", "every", "message"),
    [
        (255, 1, r"divided by 255 when read: training sees 0 to 0\.\d+; divide it by its full scale"),
        (100, 1, r"training sees 0 to 0\.3\d; divide it by its full scale"),
        (255, 2, r"in 6 of 12 scans, which are divided by 255; .* store all of them as 0\.\.1"),
        (65535, 1, r"divided by 65535 when read: training sees 0 to 0\.\d+; divide it by its full scale"),
        (65535, 2, r"in 6 of 12 scans, which are divided by 65535; the others are taken as 0\.\.1"),
        (1.5, 1, r"cut off at 1 in \d+\.\d % of the points; divide it by its full scale"),
        (0, 1, r"0 everywhere; check what exported"),
        (1 / 255, 1, r"reaches 0\.00\d+ only; store it as 0\.\.1"),
        (-1, 1, r"goes down to -0\.\d+ and is cut off at 0"),
    ],
)
def test_reflectance_on_another_scale(data: Path, scale: float, every: int, message: str) -> None:
    change_scans(data, lambda points: np.multiply(points[:, 3], scale, out=points[:, 3]), every)
    finding = found(data)[0]
    assert finding.level == "warning" and finding.about == "reflectance" and re.search(message, finding.text)


@pytest.mark.parametrize("speck", [1.02, 40.0, 300.0])
def test_a_speck_of_reflectance_is_none_that_reading_minds(data: Path, speck: float) -> None:
    change_scans(data, lambda points: points.__setitem__((0, 3), speck), every=4)
    assert found(data) == []
