"""`asca average-weights`: the average of the weights of several checkpoints."""

from pathlib import Path
from typing import Annotated

import typer

from asca_pillars.base.extras import require


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
    out: Annotated[
        Path, typer.Option("--out", "-o", help="Checkpoint to write, such as average.ckpt.", rich_help_panel="Output")
    ],
) -> None:
    """Average the weights of several checkpoints of one network.

    After a training that started from other weights (`asca train --init`), the average of both often finds more than
    either: it knows the new data, and keeps what the first weights knew of the rest. The network and its cost stay the
    same. Configuration and expected input are those of the first checkpoint; of a bundle, its score thresholds and
    suppression too.

    Examples:

    asca average-weights runs/mine/checkpoints/last.ckpt default -o average.ckpt

    asca average-weights runs/mine/checkpoints/last.ckpt default --shares 0.3,0.7 -o average.ckpt
    """
    require("train")
    from rich.console import Console

    from asca_deploy.shipped import bundle_of_checkpoint, find_checkpoint
    from asca_pillars.base.errors import ConfigError
    from asca_pillars.models.average import average_checkpoints
    from asca_pillars.models.checkpoint_file import require_new_checkpoint

    require_new_checkpoint(out)
    try:
        given = None if shares is None else [float(share) for share in shares.split(",")]
    except ValueError:
        raise ConfigError(f"--shares {shares}: give numbers and commas, such as 0.7,0.3") from None
    paths = [find_checkpoint(checkpoint) for checkpoint in checkpoints]
    bundle = bundle_of_checkpoint(checkpoints[0])
    average_checkpoints(paths, out, given, shipped_as=None if bundle is None else bundle.spec)
    Console(markup=False, soft_wrap=True).print(f"Written: {out}")
