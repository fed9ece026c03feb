"""A folder that an earlier export wrote, for tests of writing over it."""

from pathlib import Path

from asca_pillars.base.own_files import json_object

EXPORT = ("asca export", "bundle.json", json_object("file"))
"""Command, marker and its recognizer, as `atomic_directory` and `require_replaceable` take them."""


def old_bundle(folder: Path) -> Path:
    folder.mkdir()
    (folder / "a.onnx").write_text("old")
    (folder / "bundle.json").write_text('{"file": "a.onnx"}')
    return folder


def names(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())
