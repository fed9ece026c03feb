"""What the check before a release installs is what pyproject.toml states."""

import importlib.util
import tomllib
from pathlib import Path
from typing import Any

import pytest

ROOT = Path(__file__).parent.parent
SCRIPT = ROOT / ".ci" / "lowest_versions.py"
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
RUN = ("train", "sim", "eval", "import", "recordings", "openvino")


@pytest.fixture(scope="module")
def script() -> Any:
    spec = importlib.util.spec_from_file_location("lowest_versions", SCRIPT)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_every_lower_bound_is_installed(script: Any) -> None:
    found = script.lowest_versions(PROJECT, RUN)
    stated = [*PROJECT["dependencies"], *(one for extra in RUN for one in PROJECT["optional-dependencies"][extra])]
    expected = {name: bound for name, _, bound in (one.partition(";")[0].partition(">=") for one in stated)}
    assert found == {name.strip(): bound.strip() for name, bound in expected.items()}
    assert len(found) > 15 and found["torch"] and found["numba"]
    lines = script.constraints(PROJECT, RUN, ["torch==9.9", "setuptools==80"]).splitlines()
    assert lines == [f"{name}=={bound}" for name, bound in (found | {"torch": "9.9", "setuptools": "80"}).items()]


@pytest.mark.parametrize("extra", sorted(PROJECT["optional-dependencies"].keys() - {"dev"}))
def test_what_users_install_has_lower_bounds(script: Any, extra: str) -> None:
    assert script.lowest_versions(PROJECT, [extra]).keys() > script.lowest_versions(PROJECT, []).keys() - {"numba"}


def test_references_to_itself_are_resolved_and_missing_bounds_named(script: Any) -> None:
    project = {
        "name": "own",
        "dependencies": ["a[x,y]>=1.0; python_version < '4'"],
        "optional-dependencies": {"b": ["own[c]", "d ==2.1"], "c": ["c_1>=3,<4"], "bad": ["e"], "two": ["a>=2"]},
    }
    assert script.lowest_versions(project, ["b"]) == {"a": "1.0", "d": "2.1", "c_1": "3"}
    with pytest.raises(ValueError, match="'e' has no lower bound"):
        script.lowest_versions(project, ["bad"])
    with pytest.raises(ValueError, match=r"'a>=2' is elsewhere bound to 1\.0"):
        script.lowest_versions(project, ["two"])


def test_every_extra_has_commands_or_is_another_s(script: Any) -> None:
    """`sim` is numba, which every command uses."""
    assert set(script.EXTRAS) == script.BY_EXTRA.keys() | {"sim"} == set(RUN)
