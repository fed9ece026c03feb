"""The documentation is true: its code runs, its commands and links exist, and the site builds without a warning."""

import logging
import re
import shlex
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from asca_deploy import shipped
from asca_pillars.base import installation
from tests.helpers.blank_plots import blank_plots
from tests.helpers.documentation import DOCS, Block, blocks, help_of, run, write_files

PAGES = {str(page.relative_to(DOCS)): page for page in sorted(DOCS.rglob("*.md"))}
RECORDS = {"MODEL_CARD.md", "PERFORMANCE.md", "RESULTS.md", "WEIGHTS.md"}
"""Pages of measurements: their commands are the hours that the figures took."""
RUN_BY = {"OWN_CLASSES.md": "tests/test_own_classes_page.py"}
"""Pages whose blocks, one after the other, are a test of their own."""
MADE_HERE = {"DATA.md": ("data/own", "runs")}
"""What the blocks of a page make themselves, beside the files that all pages take for granted."""
JOURNEYS = (
    "index.md",
    "guide/own_scans.md",
    "SENSORS.md",
    "OWN_CLASSES.md",
    "LABELLING.md",
    "guide/deploy.md",
    "EVALUATION.md",
)


@pytest.fixture(scope="session")
def files(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("documentation")
    write_files(root)
    return root


def runs(name: str) -> list[Block]:
    return [block for block in blocks(PAGES[name]) if block.reason is None]


@pytest.mark.parametrize("name", [name for name in PAGES if runs(name) and name not in RUN_BY])
def test_every_block_runs(name: str, files: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    shutil.copytree(files, tmp_path, dirs_exist_ok=True, symlinks=True)
    for folder in MADE_HERE.get(name, ()):
        shutil.rmtree(tmp_path / folder)
    monkeypatch.chdir(tmp_path)
    blank_plots(monkeypatch)
    models = installation.shipped_models()
    for module in (installation, shipped):  # the smallest model takes the least time
        monkeypatch.setattr(module, "shipped_models", lambda: models | {"default": models["fast"]})
    logging.getLogger("asca_pillars").setLevel(logging.ERROR)
    for block in runs(name):
        run(block, name)


def not_run() -> list[tuple[str, Block]]:
    return [(name, block) for name, page in PAGES.items() for block in blocks(page) if block.reason is not None]


@pytest.mark.parametrize(("name", "block"), not_run(), ids=lambda value: value if isinstance(value, str) else "")
def test_commands_of_other_blocks_exist(name: str, block: Block) -> None:
    for command in block.commands:
        words = shlex.split(command, comments=True)
        if words[:1] != ["asca"]:
            continue
        for option in (word for word in words[2:] if re.match(r"-(?!\d)", word)):  # no negative numbers
            assert re.search(rf"(^|\s|│){re.escape(option)}\b", help_of(words[1])), f"{name}:{block.line}: {option}"


def test_blocks_that_are_not_run_are_few_and_say_why() -> None:
    left_out = [(name, block) for name, block in not_run() if name not in RECORDS]
    assert len(left_out) <= 25
    assert all(len(block.reason or "") > 10 for _, block in left_out)
    for name in JOURNEYS:
        assert runs(name), f"nothing of {name} is run"


def test_the_site_builds_without_a_warning(tmp_path: Path) -> None:
    pytest.importorskip("mkdocs", reason="needs pip install -e '.[docs]'")
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "--site-dir", str(tmp_path / "site")]
    built = subprocess.run(command, cwd=DOCS.parent, capture_output=True, text=True, timeout=300)
    assert built.returncode == 0, built.stderr
    for name in PAGES:
        page = tmp_path / "site" / name.replace("index.md", "").removesuffix(".md") / "index.html"
        assert page.is_file(), f"{name} is not on the site"
    assert "LiDAR frame" in (tmp_path / "site" / "reference" / "detector" / "index.html").read_text()
