"""Imports go one way, as docs/ARCHITECTURE.md draws it, and the packages of the vehicle need no torch."""

import ast
import re
from pathlib import Path

import pytest

from tests.helpers.package_imports import PACKAGES, ROOT, import_statements, imports

BLOCK = re.search(r"```text\n(.*?)```", (ROOT / "docs" / "ARCHITECTURE.md").read_text(encoding="utf-8"), re.DOTALL)
assert BLOCK is not None
LAYERS = [set(line.split("  ")[0].split()) for line in BLOCK[1].splitlines()]
"""Rooms of each layer: what is in one of them imports from those before it."""
LAYER_OF = {room: number for number, layer in enumerate(LAYERS) for room in layer}
NEEDS_TORCH = {"ablation", "asca_export", "cli", "models", "training"}


def modules_read(path: Path, known: set[str]) -> set[str]:
    """Modules of these packages that a file imports, within functions as well, but not for types alone."""
    found: set[str] = set()
    for node in (node for node, for_types in import_statements(path) if not for_types):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            inner = {f"{node.module}.{alias.name}" for alias in node.names} & known
            found |= inner or {str(node.module)}
    return found & known


def circles(arrows: dict[str, set[str]]) -> list[list[str]]:
    """Ways through modules that end where they begin, one for each module that is met again."""
    found, done = [], set()

    def visit(module: str, way: list[str]) -> None:
        if module in way:
            found.append([*way[way.index(module) :], module])
        elif module not in done:
            for further in sorted(arrows[module]):
                visit(further, [*way, module])
            done.add(module)

    for module in sorted(arrows):
        visit(module, [])
    return found


def test_no_module_imports_itself_through_others() -> None:
    paths = {
        ".".join((package.name, *path.relative_to(package).with_suffix("").parts)).removesuffix(".__init__"): path
        for package in PACKAGES
        for path in package.rglob("*.py")
    }
    assert circles({module: modules_read(path, set(paths)) - {module} for module, path in paths.items()}) == []


def test_a_circle_is_found() -> None:
    assert circles({"a": {"b"}, "b": {"c"}, "c": {"b"}}) == [["b", "c", "b"]]


def room_of(module: str) -> str:
    """asca_pillars.data.frames -> data, asca_deploy.bundle -> asca_deploy; a library: its first part."""
    package, _, rest = module.partition(".")
    room = rest.partition(".")[0]
    return room if package == "asca_pillars" and room in LAYER_OF else package


def upward(path: Path, package: Path) -> list[str]:
    place = path.relative_to(package).as_posix()
    own = room_of(".".join((package.name, *path.relative_to(package).with_suffix("").parts)))
    rooms = {room_of(module) for module in imports(path)} - {own}
    wrong = [room for room in rooms & set(LAYER_OF) if LAYER_OF[room] >= LAYER_OF[own]]
    wrong += [room for room in rooms & {"torch", "lightning"} if own not in NEEDS_TORCH]
    return [f"{package.name}/{place} imports {room}" for room in sorted(wrong)]


@pytest.mark.parametrize("package", PACKAGES, ids=lambda package: package.name)
def test_imports_go_one_way(package: Path) -> None:
    files = sorted(package.rglob("*.py"))
    assert len(files) > 5
    assert [line for path in files for line in upward(path, package)] == []


def test_every_folder_has_a_layer() -> None:
    names = {path.stem for path in PACKAGES[0].iterdir() if path.suffix == ".py" or (path / "__init__.py").exists()}
    assert names - {"__init__"} == set(LAYER_OF) - {"asca_pillars", "asca_deploy", "asca_export"}


@pytest.mark.parametrize(
    ("place", "line"),
    [
        ("data/made_up.py", "from asca_pillars.models.build import build_model"),
        ("geometry/made_up.py", "from asca_pillars.ops.pillar import grid"),
        ("ops/made_up.py", "def late():\n    import torch.nn"),
        ("models/made_up.py", "import asca_deploy.detector"),
    ],
)
def test_a_wrong_import_is_found(tmp_path: Path, place: str, line: str) -> None:
    path = tmp_path / "asca_pillars" / place
    path.parent.mkdir(parents=True)
    path.write_text(f"import numpy\nfrom asca_pillars.base.errors import AscaError\n{line}\n")
    assert len(upward(path, tmp_path / "asca_pillars")) == 1


def test_tests_share_helpers_and_not_each_other() -> None:
    shared = {
        (path.relative_to(ROOT).as_posix(), name)
        for path in (ROOT / "tests").rglob("test_*.py")
        for name in imports(path)
        if re.search(r"^tests\..*\btest_\w+(\.\w+)?$", name) and path.stem not in name.split(".")
    }
    assert shared == set(), "move what both use to a module beside them, or to tests/helpers"
