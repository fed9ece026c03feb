"""Whether a leak is seen through the allocator's ups and downs, and the ups and downs are not taken for one."""

from itertools import islice

import numpy as np
import pytest

from benchmarks.memory import CHUNK, CYCLE, crops, cycle_levels
from tests.helpers.scenes import make_scene

COUNTS = np.arange(CYCLE, 6 * CYCLE, CHUNK, dtype=np.float64)
UPS_AND_DOWNS = 300 + np.abs(np.random.default_rng(0).normal(0, 2, len(COUNTS)))


def test_what_comes_and_goes_is_no_leak() -> None:
    levels = cycle_levels(COUNTS, UPS_AND_DOWNS)
    assert len(levels) == 5 and abs(levels[-1] - levels[0]) < 0.5
    assert np.ptp(UPS_AND_DOWNS) > 5, "from moment to moment it may look like one"


def test_a_leak_is_seen() -> None:
    levels = cycle_levels(COUNTS, UPS_AND_DOWNS + COUNTS / CYCLE)
    assert levels[-1] - levels[0] == pytest.approx(4, abs=0.5)


def test_a_short_run_is_halved() -> None:
    assert len(cycle_levels(COUNTS[:10], UPS_AND_DOWNS[:10])) == 2


def test_crops_are_of_many_sizes_and_begin_alike() -> None:
    points = make_scene(0)[0]
    sizes = [len(crop) for crop in islice(crops(points), 50)]
    assert len(set(sizes)) > 10 and max(sizes) <= len(points)
    assert sizes == [len(crop) for crop in islice(crops(points), 50)]
