"""Docstrings name modules, parameters and attributes that exist."""

import ast
import pkgutil
import re
from pathlib import Path

PACKAGES = ("asca_pillars", "deploy/asca_deploy", "export/asca_export")


def test_names_of_modules_lead_somewhere() -> None:
    """`part.module.name` in a docstring or comment is what stands in asca_pillars/part/module.py."""
    parts = "|".join(folder.name for folder in Path("asca_pillars").iterdir() if (folder / "__init__.py").is_file())
    named = re.compile(rf"`((?:{parts})(?:\.[a-z_]+)+\.\w+)`")
    paths = [path for package in PACKAGES for path in Path(package).rglob("*.py")]
    names = {name for path in paths for name in named.findall(path.read_text())}
    assert len(names) > 10
    for name in names:
        pkgutil.resolve_name(f"asca_pillars.{name}")


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
