"""Docstrings name modules, parameters and attributes that exist."""

import ast
import pkgutil
import re
from pathlib import Path

PACKAGES = ("asca_pillars", "deploy/asca_deploy", "export/asca_export")
OF_OTHERS = {
    *("SyncBatchNorm", "estimated_stepping_batches", "parallel"),  # torch, Lightning, numba
    *("av2", "iou_3d_axis_aligned", "kitti_untransformed", "lidar_utils"),  # Argoverse, labelCloud, Waymo
    *("NAME_bev", "NAME_image"),  # of any scan
    *("net", "core", "rmem_max", "metadata", "google", "internal"),  # Linux, Google Cloud
}
"""Names that the code mentions and does not use."""
_IN_BACKTICKS = re.compile(r"`([A-Za-z_]\w*(?:\.[A-Za-z_]\w*)*)(?:\([^`]*\))?`")


def test_names_of_modules_lead_somewhere() -> None:
    """`part.module.name` in a docstring or comment is what stands in asca_pillars/part/module.py."""
    parts = "|".join(folder.name for folder in Path("asca_pillars").iterdir() if (folder / "__init__.py").is_file())
    named = re.compile(rf"`((?:{parts})(?:\.[a-z_]+)+\.\w+)`")
    paths = [path for package in PACKAGES for path in Path(package).rglob("*.py")]
    names = {name for path in paths for name in named.findall(path.read_text())}
    assert len(names) > 10
    for name in names:
        pkgutil.resolve_name(f"asca_pillars.{name}")


def test_names_in_backticks_are_those_of_something() -> None:
    """Whatever a docstring, comment or page names as `this` or `that.attribute` stands in the code."""
    known = _names_in_code()
    named: dict[str, set[str]] = {}
    for path in (path for package in PACKAGES for path in Path(package).rglob("*.py")):
        sentences = (line for line in path.read_text().splitlines() if " " in line.strip())  # no compressed data
        for name in _IN_BACKTICKS.findall("\n".join(sentences)):
            named.setdefault(name, set()).add(str(path))
    for path in (Path("README.md"), *Path("docs").rglob("*.md")):
        prose, *blocks = re.split(r"^ *```.*$", path.read_text(), flags=re.MULTILINE)
        known_here = known.union(*(re.findall(r"\w+", block) for block in blocks[::2]))
        for name in _IN_BACKTICKS.findall("\n".join((prose, *blocks[1::2]))):
            if "." in name and not set(name.split(".")) <= known_here:
                named.setdefault(name, set()).add(str(path))
    assert len(named) > 800
    gone = {name: paths for name, paths in named.items() if not set(name.split(".")) <= known | OF_OTHERS}
    assert gone == {}


def _names_in_code() -> set[str]:
    """Return all identifiers and short texts of the code, identifiers of its tests, and the parts of files' names."""
    names: set[str] = set()
    for path in (
        path for folder in (*PACKAGES, "configs", "benchmarks", "tests", "examples") for path in Path(folder).rglob("*")
    ):
        names.update(re.findall(r"\w+", path.name))
        if path.suffix in (".yaml", ".js", ".html", ".md"):
            names.update(re.findall(r"\w+", path.read_text()))
        for node in ast.walk(ast.parse(path.read_text())) if path.suffix == ".py" else ():
            for field, value in ast.iter_fields(node):
                if isinstance(value, str) and field in ("id", "attr", "name", "arg", "asname", "module"):
                    names.update(value.split("."))
            if path.parts[0] == "tests":  # whose texts are also about what is wrong
                continue
            if isinstance(node, ast.Constant) and isinstance(node.value, str) and len(node.value) < 60:
                names.update(re.findall(r"\w+", node.value))
    return names


def test_described_parameters_and_attributes_exist() -> None:
    described, gone = 0, []
    for path in (path for package in PACKAGES for path in Path(package).rglob("*.py")):
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.FunctionDef | ast.ClassDef):
                names = _described_names(ast.get_docstring(node) or "")
                described += len(names)
                gone += [f"{path}: {node.name}: {name}" for name in names - _own_names(node)]
    assert described > 1000 and gone == []


def _described_names(docstring: str) -> set[str]:
    """Return the names in the sections Args and Attributes."""
    sections = re.findall(r"^(?:Args|Attributes):\n((?:    .*\n|\n)+)", docstring + "\n", re.MULTILINE)
    entries = [re.findall(r"^    ([a-z_]\w*(?:, \w+)*):(?: |$)", section, re.MULTILINE) for section in sections]
    return {name for section in entries for entry in section for name in entry.split(", ")}


def _own_names(node: ast.AST) -> set[str]:
    """Return the names of all parameters, attributes, variables and functions in a function or class."""
    kinds = {ast.arg: "arg", ast.Attribute: "attr", ast.Name: "id", ast.FunctionDef: "name"}
    return {getattr(one, kinds[type(one)]) for one in ast.walk(node) if type(one) in kinds}
