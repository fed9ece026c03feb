"""Caches that training needs of a dataset, computed before it instead of during its first epoch."""

from dataclasses import replace
from pathlib import Path

from asca_pillars.base.progress import SILENT, Reporter
from asca_pillars.config.tree import Config
from asca_pillars.data.insertion.free_space import prepare_free_spaces
from asca_pillars.data.insertion.insert_objects import Inserter, prepare_inserter
from asca_pillars.data.open_split import open_split
from asca_pillars.models.build import build_preparation


def prepare(config: Config, data: str | Path, *, workers: int, reporter: Reporter = SILENT) -> Inserter | None:
    """Compute the object database and the maps of free ground, or for a second stage the proposals of its first.

    What is there and unchanged is used again.

    Args:
        config: of the training. Without an insertion method in it, what RS-Aug needs is prepared.
        data: a dataset's folder.
        workers: processes.
        reporter: for the progress.

    Returns:
        What inserts objects; None for a second stage, which has no insertion.

    Raises:
        AscaError: a frame cannot be read, or a file not be written.
    """
    settings = replace(config.data, workers=workers)
    if config.model.kind == "pillar_refine":
        for name in (settings.train_set, settings.val_set):
            build_preparation(config.model, open_split(data, name), settings, reporter)
        return None
    insert = config.augment.insert
    insert = insert if insert.method != "none" else replace(insert, method="rs_aug")
    split = open_split(data, settings.train_set)
    inserter = prepare_inserter(split, config.model.spec, settings, insert, reporter)
    if insert.method == "rs_aug":
        view = inserter.camera_view
        prepare_free_spaces(split, inserter.prepared, camera_view=view, workers=workers, reporter=reporter)
    return inserter
