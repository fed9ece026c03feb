"""Public functions with arrays state the shape, and the unit, frame or meaning of the values."""

import functools
import pkgutil
import re
from pathlib import Path

import pytest

from benchmarks.docstrings import PACKAGES, Documented, documented

BAR = 0.9
UNDOCUMENTED = '''
from numpy.typing import NDArray

_Floats = NDArray[float]


def aliased(values: _Floats) -> float:
    """Sum."""


def plain(number: int) -> int:
    """A function without arrays does not count."""


class Cloud:
    """Points (N, 3) in metres, LiDAR frame."""

    def __init__(self, points: NDArray[float]) -> None: ...

    def distances(self) -> NDArray[float]:
        """From the sensor, (N,)."""
'''


@functools.cache
def of_the_package() -> list[Documented]:
    return list(documented())


@pytest.mark.parametrize("part", ["shape", "unit"])
def test_docstrings_of_functions_with_arrays_state(part: str) -> None:
    found = of_the_package()
    lacking = [one.place for one in found if not getattr(one, part)]
    assert len(found) > 100
    assert 1 - len(lacking) / len(found) >= BAR, f"{part} is missing in\n" + "\n".join(lacking)


def test_a_function_without_shape_or_unit_is_found(tmp_path: Path) -> None:
    (tmp_path / PACKAGES[0]).mkdir()
    (tmp_path / PACKAGES[0] / "cloud.py").write_text(UNDOCUMENTED)
    found = {one.place.split()[1]: (one.shape, one.unit) for one in documented(tmp_path)}
    assert found == {"aliased": (False, False), "Cloud.__init__": (True, True), "Cloud.distances": (True, False)}


def test_names_of_modules_lead_somewhere() -> None:
    """`part.module.name` in a docstring or comment is what stands in asca_pillars/part/module.py."""
    parts = "|".join(folder.name for folder in Path("asca_pillars").iterdir() if (folder / "__init__.py").is_file())
    named = re.compile(rf"`((?:{parts})(?:\.[a-z_]+)+\.\w+)`")
    paths = [path for package in PACKAGES for path in Path(package).rglob("*.py")]
    names = {name for path in paths for name in named.findall(path.read_text())}
    assert len(names) > 10
    for name in names:
        pkgutil.resolve_name(f"asca_pillars.{name}")
