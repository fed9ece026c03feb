"""Docstrings name modules that exist."""

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
