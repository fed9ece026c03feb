"""`asca inspect --draw`: pictures of training frames in a folder of their own."""

from dataclasses import replace
from pathlib import Path

from rich.console import Console

from asca_pillars.base.files import atomic_directory, write_json
from asca_pillars.base.own_files import json_object, require_replaceable
from asca_pillars.config.tree import Config
from asca_pillars.data.training_frames import open_frames
from asca_pillars.pictures.training_pictures import draw_training_frames

MADE_BY = "inspection.json"
PICTURES_FOLDER = ("asca inspect --draw", MADE_BY, json_object("data", "split", "config", "files"))
"""Command, marker and its recognizer, as `atomic_directory` takes them."""


def require_replaceable_pictures(out: Path) -> None:
    """OutputError where `out` holds something else than pictures of an earlier run."""
    require_replaceable(out, *PICTURES_FOLDER)


def draw_frames(data: Path, split: str, config: Config, count: int, out: Path, console: Console) -> None:
    """Write pictures of `count` frames of the list `split` to `out` and name them; an earlier run's are replaced.

    Raises:
        OutputError: `out` holds something else.
        DatasetError, ScanError: a frame cannot be read.
    """
    config = replace(config, data=replace(config.data, train_set=split))
    frames = open_frames(data, config, training=True)
    with atomic_directory(out, *PICTURES_FOLDER) as folder:
        said = draw_training_frames(folder, frames, count)
        about = {"data": str(data), "split": split, "config": config.name}
        write_json(folder / MADE_BY, about | {"files": sorted(path.name for path in folder.iterdir())})
    for line in said:
        console.print(line.replace(str(folder), str(out)), soft_wrap=True)
