"""Error handling of commands: a user's error is one line on stderr and an exit code by its kind."""

import io
import sys
from collections.abc import Callable
from pathlib import Path
from typing import NoReturn

import typer

from asca_pillars.base.errors import ENVIRONMENT, INPUT, AscaError, printable


def run_command(command: Callable[..., object], name: str | None = None) -> None:
    """Run a Typer application, or a function whose parameters Typer reads from the command line.

    Args:
        command: the command.
        name: start of error messages; None is the name of the running script.
    """
    name = name or Path(sys.argv[0]).stem
    if isinstance(sys.stdout, io.TextIOWrapper):
        sys.stdout.reconfigure(errors="replace")  # an ASCII terminal shows `?` for `°` instead of a traceback
    try:
        command() if isinstance(command, typer.Typer) else typer.run(command)
    except AscaError as error:
        _fail(name, str(error), error.exit_code)
    except OSError as error:
        reason = str(error.strerror or error)
        missing = isinstance(error, FileNotFoundError | IsADirectoryError | NotADirectoryError)
        message = f"{error.filename}: {reason}" if error.filename else reason
        _fail(name, message, INPUT if missing else ENVIRONMENT)
    except MemoryError as error:
        reason = str(error) or "allocation failed"
        _fail(name, f"out of memory ({reason}); use a smaller input, or a machine with more memory", ENVIRONMENT)
    except RecursionError:
        _fail(name, "the input is nested too deeply to be read; simplify the file or the option", INPUT)


def _fail(name: str, message: str, code: int) -> NoReturn:
    print(f"{name}: {printable(message)}", file=sys.stderr)
    sys.exit(code)
