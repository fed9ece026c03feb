"""Whether a leak is seen through the allocator's ups and downs, and the ups and downs are not taken for one."""

import numpy as np
import pytest

from benchmarks.memory import CHUNK, CYCLE, cycle_floors

COUNTS = np.arange(CYCLE, 6 * CYCLE, CHUNK, dtype=np.float64)
UPS_AND_DOWNS = 300 + np.abs(np.random.default_rng(0).normal(0, 2, len(COUNTS)))


def test_what_comes_and_goes_is_no_leak() -> None:
    floors = cycle_floors(COUNTS, UPS_AND_DOWNS)
    assert len(floors) == 5 and abs(floors[-1] - floors[0]) < 0.1
    assert abs(UPS_AND_DOWNS[-1] - UPS_AND_DOWNS[0]) > 0.1, "from moment to moment it looks like one"


def test_a_leak_is_seen() -> None:
    floors = cycle_floors(COUNTS, UPS_AND_DOWNS + COUNTS / CYCLE)
    assert floors[-1] - floors[0] == pytest.approx(4, abs=0.5)


def test_a_short_run_is_halved() -> None:
    assert len(cycle_floors(COUNTS[:10], UPS_AND_DOWNS[:10])) == 2
