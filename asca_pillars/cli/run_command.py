"""How a command ends: what the user can mend is one line on stderr and exit code 2."""

import io
import sys
from collections.abc import Callable
from pathlib import Path
from typing import NoReturn

import typer

from asca_pillars.base.errors import AscaError, printable


def run_command(command: Callable[..., object], name: str | None = None) -> None:
    """Run a Typer application, or a function whose parameters Typer reads from the command line.

    Args:
        command: what to run.
        name: what a message begins with; None is the name of the script that runs.
    """
    name = name or Path(sys.argv[0]).stem
    if isinstance(sys.stdout, io.TextIOWrapper):
        sys.stdout.reconfigure(errors="replace")  # an ASCII terminal gets `?` for `°`, not a traceback
    try:
        command() if isinstance(command, typer.Typer) else typer.run(command)
    except AscaError as error:
        _fail(name, str(error))
    except OSError as error:
        reason = str(error.strerror or error)
        _fail(name, f"{error.filename}: {reason}" if error.filename else reason)
    except MemoryError as error:
        _fail(
            name, f"not enough memory ({str(error) or 'no more is to be had'}); give it smaller input, or more memory"
        )
    except RecursionError:
        _fail(name, "the input is nested too deeply to be read; simplify the file or the option")


def _fail(name: str, message: str) -> NoReturn:
    print(f"{name}: {printable(message)}", file=sys.stderr)
    sys.exit(2)
