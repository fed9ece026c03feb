"""Where numba is installed its forms run: without this, tests of both forms would compare NumPy with itself."""

import pytest

from asca_pillars.points.load_point_kernels import load_point_kernels


def test_compiled_forms_are_used() -> None:
    pytest.importorskip("numba")
    assert load_point_kernels() is not None
