"""`asca average-weights`: the average of the weights of several checkpoints."""

import shutil
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Annotated

import typer

from asca_pillars.base.installation import require


def average_weights(
    checkpoints: Annotated[
        list[str],
        typer.Argument(help="Two or more checkpoints, or bundles that hold their weights, such as default."),
    ],
    *,
    shares: Annotated[
        str | None,
        typer.Option(help="Share of each, such as 0.7,0.3. Default: equal ones.", rich_help_panel="Input"),
    ] = None,
    update_bn: Annotated[
        Path | None,
        typer.Option(
            "--update-bn",
            metavar="DATASET",
            help="Compute the statistics of batch normalization on 500 frames of this dataset. Default: the average of "
            "theirs, which are off for an average of weights.",
            rich_help_panel="Input",
        ),
    ] = None,
    split: Annotated[
        str | None,
        typer.Option(
            help="List of its frames, such as training for all. Default: what the first checkpoint was trained on.",
            rich_help_panel="Input",
        ),
    ] = None,
    out: Annotated[
        Path, typer.Option("--out", "-o", help="Checkpoint to write, such as average.ckpt.", rich_help_panel="Output")
    ],
) -> None:
    """Average the weights of several checkpoints of one network.

    After a training that started from other weights (`asca train --init`), the average of both often finds more than
    either: it knows the new data, and keeps what the first weights knew of the rest. The network and its cost stay the
    same. Configuration and expected input are those of the first checkpoint; of a bundle, its score thresholds and
    suppression too. With --update-bn the statistics of batch normalization are computed again, as
    torch.optim.swa_utils.update_bn does: give hundreds of scans like those of the trainings.

    Examples:

    asca average-weights runs/mine/checkpoints/last.ckpt default -o average.ckpt

    asca average-weights runs/mine/checkpoints/last.ckpt default --shares 0.3,0.7 --update-bn data/sim -o average.ckpt
    """
    require("train")
    from rich.console import Console

    from asca_deploy.shipped import bundle_of_checkpoint, find_checkpoint
    from asca_pillars.base.errors import ConfigError
    from asca_pillars.base.files import atomic_path
    from asca_pillars.base.progress import Reporter
    from asca_pillars.cli.progress import Bars
    from asca_pillars.models.checkpoint_file import require_new_checkpoint
    from asca_pillars.training.average_weights import average_checkpoints, update_batch_norm

    if split is not None and update_bn is None:
        raise ConfigError(f"--split {split}: names frames of --update-bn; give that too, or leave it out")
    require_new_checkpoint(out)
    try:
        given = None if shares is None else [float(share) for share in shares.split(",")]
    except ValueError:
        raise ConfigError(f"--shares {shares}: give numbers separated by commas, such as 0.7,0.3") from None
    paths = [find_checkpoint(checkpoint) for checkpoint in checkpoints]
    bundle = bundle_of_checkpoint(checkpoints[0])
    console = Console(markup=False, soft_wrap=True)
    with TemporaryDirectory() as folder:
        average = Path(folder) / out.name
        average_checkpoints(paths, average, given, shipped_as=None if bundle is None else bundle.spec)
        if update_bn is not None:
            with Bars(console) as bars:
                update_batch_norm(average, update_bn, split, reporter=Reporter(bars))
        with atomic_path(out) as temporary:
            shutil.copyfile(average, temporary)
    console.print(f"Written: {out}")
