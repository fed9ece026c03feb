"""Registration of the commands of `asca`. Each command imports its dependencies when it runs."""

import inspect as inspect_module
from collections.abc import Callable
from typing import Annotated

import typer

from asca_pillars import __version__
from asca_pillars.cli.ablate import ablate
from asca_pillars.cli.adapt import adapt
from asca_pillars.cli.average_weights import average_weights
from asca_pillars.cli.bench import bench
from asca_pillars.cli.bundle import app as bundle
from asca_pillars.cli.detect import detect
from asca_pillars.cli.doctor import doctor
from asca_pillars.cli.eval import evaluate
from asca_pillars.cli.export import export
from asca_pillars.cli.import_dataset import import_dataset, import_weights
from asca_pillars.cli.inspect import inspect
from asca_pillars.cli.ros2 import ros2
from asca_pillars.cli.run_command import run_command
from asca_pillars.cli.simulate import simulate
from asca_pillars.cli.train import prepare, train
from asca_pillars.cli.view import view

app = typer.Typer(
    help="LiDAR 3D detection: boxes from a point cloud on an ordinary CPU, and the pipeline that trains the model.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
)


def _add(function: Callable[..., None], name: str | None = None) -> None:
    """Register a command; each paragraph of its help is one line, which the terminal breaks where it is full."""
    paragraphs = inspect_module.cleandoc(function.__doc__ or "").split("\n\n")
    app.command(name, help="\n\n".join(" ".join(text.split()) for text in paragraphs))(function)


_add(detect)
_add(view)
_add(bench)
_add(simulate)
_add(import_dataset, "import")
_add(inspect)
_add(prepare)
_add(train)
_add(adapt)
_add(evaluate, "eval")
_add(export)
_add(average_weights, "average-weights")
_add(import_weights, "import-weights")
app.add_typer(bundle, name="bundle")
_add(ablate)
_add(ros2)
_add(doctor)


def main() -> None:
    """Run the command; a user's error is one line on stderr and an exit code by its kind."""
    run_command(app, "asca")


@app.callback(invoke_without_command=True)
def _version(
    version: Annotated[bool, typer.Option("--version", help="Print the version and stop.")] = False,
) -> None:
    if version:
        print(__version__)
        raise typer.Exit


if __name__ == "__main__":
    main()
