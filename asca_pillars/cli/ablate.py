"""`asca ablate`: the paper's Table 5 on any KITTI-layout data: training, evaluation, timing and report."""

from pathlib import Path
from typing import Annotated

import typer

from asca_pillars.base.installation import require
from asca_pillars.cli.options import InitOption, OverridesOption


def ablate(
    config: Annotated[
        str,
        typer.Argument(
            help="Base: a YAML, or the name of one that ships: ablation_small for the rows of pillar detectors, "
            "ablation_two_stage for those of PV-RCNN."
        ),
    ],
    *,
    data: Annotated[
        Path,
        typer.Option(
            "--data", "-d", help="KITTI-layout folder with ImageSets/{train,val}.txt.", rich_help_panel="Input"
        ),
    ],
    override: OverridesOption = None,
    seeds: Annotated[
        str, typer.Option("--seeds", help="Seeds of every variant, separated by commas.", rich_help_panel="Input")
    ] = "0,1",
    variants: Annotated[
        str, typer.Option("--variants", help="Names separated by commas, or all.", rich_help_panel="Input")
    ] = "all",
    init: InitOption = None,
    out: Annotated[
        Path,
        typer.Option("--out", "-o", help="Folder of the runs; finished ones there are kept.", rich_help_panel="Output"),
    ],
    jobs: Annotated[
        int,
        typer.Option(
            "--jobs", min=1, help="Trainings at a time; they share the CPU cores.", metavar="N", rich_help_panel="Speed"
        ),
    ] = 1,
) -> None:
    """Train and compare: with and without ASP, CPA, GT-Aug and RS-Aug, other K, the readings of CPA; write one table.

    Table 5 of the paper, on equal terms and with the spread over the seeds, on whatever data you have. On a base of
    kind pv_rcnn the rows are what later papers add to it: deformation, gate, VectorPool, dual attention, MSAA, VA loss,
    and other numbers of keypoints. Goes on where it stopped when the same command is given again.

    Examples:

    asca ablate ablation_small --data data/ablation --out runs/ablation --seeds 0,1,2

    asca ablate ablation_two_stage --data data/ablation --out runs/two_stage --variants pv_rcnn,deform_paper

    asca ablate ablation_two_stage --data data/ablation --out runs/second -s model.train_first_stage=false --init
    pvrcnn_small_sim --variants pv_rcnn,deform_paper
    """
    require("train")
    from rich.console import Console
    from rich.markdown import Markdown

    from asca_pillars.ablation.ablation_runs import finish_runs, read_results, runs, tables
    from asca_pillars.base.files import write_text
    from asca_pillars.base.own_files import page_end
    from asca_pillars.base.progress import Reporter
    from asca_pillars.base.schema import to_dict
    from asca_pillars.base.system import default_threads
    from asca_pillars.cli.ablate_steps import (
        COMMAND,
        RESULTS_FILE,
        check,
        family_of,
        parse_seeds,
        parse_variants,
        require_same_base,
        setup,
        time_variants,
    )
    from asca_pillars.cli.progress import Bars
    from asca_pillars.config.tree import load_config
    from asca_pillars.data.kitti import KittiSplit
    from asca_pillars.training.dataset import prepare

    console = Console(markup=False)
    overrides = override or []
    base = load_config(config, overrides)
    family = family_of(base)
    rows = parse_variants(variants, family)
    todo = runs(out, parse_seeds(seeds), rows)
    check(rows, config, overrides, data, init)
    require_same_base(out, {"config": to_dict(base), "data": str(data)} | ({} if init is None else {"init": str(init)}))
    waiting = [load_config(config, [*overrides, *run.variant.overrides]) for run in todo if not run.trained.exists()]
    if any(settings.augment.insert.method != "none" for settings in waiting):
        # Checked once, not by every run.
        with Bars(console) as bars:
            prepare(base, data, workers=default_threads(), reporter=Reporter(bars))
    with Bars(console) as bars:
        finish_runs(todo, config, data, base.data.val_set, jobs, overrides, init, reporter=Reporter(bars))
    speeds = time_variants(todo, family, KittiSplit(data, base.data.val_set), console)
    text = f"{setup(todo, config, data, base.data, jobs)}\n{tables(family, read_results(todo), speeds)}"
    path = out / RESULTS_FILE
    write_text(path, text + page_end(COMMAND))
    console.print(Markdown(text))
    console.print(f"Written: {path}")
