"""The advice to install an extra: from a source tree, and where a wheel was installed."""

import shutil
import subprocess
import sys
import tomllib
from pathlib import Path

from asca_pillars.base import errors, installation
from asca_pillars.base.installation import EXTRAS, install_command, source_tree, upgrade_advice

ROOT = Path(__file__).parents[2]


def test_in_a_source_tree_the_advice_names_it() -> None:
    assert source_tree() == ROOT
    assert install_command("train") == f"pip install -e '{ROOT}[train]'"
    assert upgrade_advice() == f"upgrade with `git -C {ROOT} pull`"


def test_of_a_wheel_the_advice_names_the_package(tmp_path: Path) -> None:
    """A stranger's pyproject.toml beside the packages, as some wheels install one, makes no source tree."""
    package = tmp_path / "site packages" / "asca_pillars"
    (package / "base").mkdir(parents=True)
    for module in (errors, installation):
        shutil.copy(str(module.__file__), package / "base")
    for folder in (package, package / "base"):
        (folder / "__init__.py").touch()
    (package.parent / "pyproject.toml").write_text('[project]\nname = "other"\n')
    code = "from asca_pillars.base.installation import *; print(install_command('train')); print(upgrade_advice())"

    def advice() -> list[str]:
        command = [sys.executable, "-c", code]
        done = subprocess.run(command, cwd=package.parent, env={}, check=True, capture_output=True, text=True)
        return done.stdout.splitlines()

    assert advice() == ["pip install 'asca-pillars[train]'", "install a newer asca-pillars"]
    (package.parent / "pyproject.toml").write_text('[project]\nname = "asca-pillars"\n')
    assert advice()[0] == f"pip install -e '{package.parent}[train]'"


def test_every_extra_that_is_advised_exists() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    assert EXTRAS.keys() <= project["optional-dependencies"].keys()
