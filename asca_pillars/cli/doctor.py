"""`asca doctor`: capabilities of this machine, and how to install missing parts."""

from typing import Annotated

import typer


def doctor(
    *, json: Annotated[bool, typer.Option("--json", help="Print everything as JSON instead, for programs.")] = False
) -> None:
    """Say what is installed, what can run here, and what to install for the rest.

    The exit code is 1 if the bundled model does not run here.
    """
    import json as json_module

    from rich.console import Console

    from asca_pillars.cli.doctor_checks import check_machine, print_checks

    checks = check_machine()
    if json:
        print(json_module.dumps(checks, indent=1))
    else:
        print_checks(checks, Console(markup=False))
    if not checks["model"]["ok"]:
        raise typer.Exit(1)
