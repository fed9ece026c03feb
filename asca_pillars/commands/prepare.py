"""`asca prepare`: what insertion needs of a dataset, computed before training instead of during its first epoch."""

from dataclasses import replace
from pathlib import Path

from rich.console import Console

from asca_pillars.commands.extras import require


def run(config: Path, data: Path, overrides: list[str], workers: int) -> None:
    """See `asca prepare --help`."""
    from asca_pillars.config import load_config

    settings = load_config(config, overrides)
    require("train")
    from asca_pillars.data.insertion.free_maps import prepare_free_spaces
    from asca_pillars.data.insertion.insert_objects import prepare_inserter
    from asca_pillars.data.kitti import KittiSplit

    # A config that is not decided yet gets what either method needs.
    insert = settings.augment.insert
    insert = insert if insert.method != "none" else replace(insert, method="rs_aug")
    spec, view = settings.model.spec, settings.data.camera_view
    split = KittiSplit(data, settings.data.train_set)
    inserter = prepare_inserter(split, spec, settings.data, insert)
    if insert.method == "rs_aug":
        prepare_free_spaces(split, inserter.prepared, camera_view=view, workers=workers)
    lines = [f"{inserter.database.path}: {len(inserter.database)} objects of {len(split.frame_ids)} frames"]
    for name, objects, share in zip(spec.class_names, inserter.candidates, inserter.shares, strict=True):
        lines.append(f"  {name}: {len(objects)} with {insert.min_points} or more points, drawn {share:.0%} of the time")
    Console(markup=False).print("\n".join(lines), soft_wrap=True, highlight=False)
