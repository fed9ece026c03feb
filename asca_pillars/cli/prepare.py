"""`asca prepare`: computation of the caches for insertion before training instead of during its first epoch."""

from typing import Annotated

import typer

from asca_pillars.base.installation import require
from asca_pillars.cli.options import ConfigArgument, DataOption, OverridesOption


def prepare(
    config: ConfigArgument,
    *,
    data: DataOption,
    override: OverridesOption = None,
    kitti_split: Annotated[
        bool,
        typer.Option(
            "--kitti-split",
            help="Before that, write ImageSets/train.txt and val.txt with the 3,712 and 3,769 frames that papers train "
            "and validate on (Chen et al., 2015), for KITTI's 7,481 scans.",
            rich_help_panel="Output",
        ),
    ] = False,
    workers: Annotated[
        int, typer.Option("--workers", "-w", min=1, help="Processes.", metavar="N", rich_help_panel="Speed")
    ] = 2,
) -> None:
    """Compute once what training needs of a dataset.

    For GT-Aug and RS-Aug the object database and the maps of free ground, for a second stage the proposals of its
    first. Training does the same on first use; what is there and unchanged is used again. Without an insertion method
    in the config, what RS-Aug needs is prepared.
    """
    from rich.console import Console

    from asca_pillars.base.progress import Reporter
    from asca_pillars.cli.progress import Bars
    from asca_pillars.config.tree import load_config

    settings = load_config(config, override or ())
    console = Console(markup=False)
    if kitti_split:
        from asca_pillars.data.kitti.kitti_split import write_train_val_lists

        for path in write_train_val_lists(data):
            console.print(f"written: {path}", soft_wrap=True, highlight=False)
    require("train")
    from asca_pillars.training.prepare import prepare as run

    with Bars(console) as bars:
        inserter = run(settings, data, workers=workers, reporter=Reporter(bars))
    if inserter is None:
        return
    database, least = inserter.database, inserter.settings.min_points
    lines = [f"{database.path}: {len(database)} objects of {len(inserter.split.frame_ids)} frames"]
    for name, objects, share in zip(settings.model.spec.class_names, inserter.candidates, inserter.shares, strict=True):
        lines.append(f"  {name}: {len(objects)} with {least} or more points, drawn {share:.0%} of the time")
    console.print("\n".join(lines), soft_wrap=True, highlight=False)
