"""Fuzzing of every reader, and of every file that a command writes and resumes from.

    python -m benchmarks.fuzz --minutes 20 --seed 7

Valid small files are changed at random (bits, bytes, numbers; pieces removed, repeated, swapped between files) and
read as by a command. Reading has to succeed or to raise one AscaError; a command that resumes from its results has to
come to those of an undamaged file. Nothing may be written outside the folder of the file. The exit code is 1 if
anything else happened; it is printed with the number of the input, which `--first NUMBER --inputs 1` reads again.
"""

import math
import os
import re
import signal
import tempfile
import time
import traceback
import warnings
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import FrameType
from typing import Annotated, Any

import numpy as np
import typer
from rich.console import Console
from rich.progress import Progress

from asca_pillars.base.errors import AscaError
from asca_pillars.cli.run_command import run_command
from asca_pillars.evaluation.report_page import markdown_table
from benchmarks import fuzz_inputs, fuzz_results
from benchmarks.fuzz_inputs import Kind

LEFT = "left outside"
OUTCOMES = ("read", "refused", "traceback", "slow", "not finite", "too many points", LEFT)
BAD = OUTCOMES[2:]
SLOW_S = 5.0
_NUMBER = re.compile(rb"-?\d+(?:\.\d+)?")
_WORDS = (
    *(b"0", b"-1", b"1e400", b"nan", b"inf", b"-inf", b"1e308", b"9" * 18, b"9" * 5000, b"2147483648", b"1_0"),
    *(b"", b" ", b"\n", b"\x00", b"\xff\xfe", b"[", b"{a: ", b"&a *a", b"*a", b"!!python/name:os.system", b"null"),
    *(b'"', b"[" * 3000, b"{a: " * 3000, b"true", b"2026-99-99", b"<<: {a: 1}", b"x" * 3000, b"\x1b[2J", b"../" * 9),
)


class _Slow(BaseException):
    """Timeout of reading."""


def main(
    minutes: Annotated[float, typer.Option(min=0, help="Stop after so many.")] = 1.0,
    inputs: Annotated[int | None, typer.Option(min=1, help="Stop after so many inputs.")] = None,
    seed: Annotated[int, typer.Option(min=0)] = 0,
    first: Annotated[int, typer.Option(min=0, help="Number of the first input.")] = 0,
    kind: Annotated[str, typer.Option(help="Only kinds whose name contains this.")] = "",
) -> None:
    """Read damaged files and count the outcomes."""
    with tempfile.TemporaryDirectory(prefix="asca-fuzz-") as folder:
        counts, failures = fuzz(Path(folder), seed, first, inputs, minutes * 60, kind, Console())
    names = sorted({name for name, _ in counts})
    rows = [(name, *(str(counts[name, outcome]) for outcome in OUTCOMES)) for name in names]
    print(f"{sum(counts.values())} inputs, seed {seed}\n\n{markdown_table(('kind', *OUTCOMES), rows, left=1)}")
    print("\n".join(failures[:20]))
    raise typer.Exit(int(bool(failures)))


def kinds(folder: Path) -> list[Kind]:
    """Return every kind of input; the files of each are written below `folder`."""
    below = folder / "some" / "where" / "below"  # paths that lead upwards stay within the compared folder
    return [*fuzz_inputs.kinds(folder / "inputs"), *fuzz_results.kinds(below)]


def fuzz(
    folder: Path,
    seed: int,
    first: int = 0,
    inputs: int | None = None,
    seconds: float = math.inf,
    only: str = "",
    console: Console | None = None,
) -> tuple[Counter[tuple[str, str]], list[str]]:
    """Read damaged files until `inputs` or `seconds` are over.

    Input number n of a seed is the same whatever came before it.

    Returns:
        how many inputs of each kind had each outcome, and a description of each bad one.
    """
    chosen = [kind for kind in kinds(folder) if only in kind.name]
    shares = np.array([kind.share for kind in chosen])
    for kind in chosen:
        read(kind, kind.seeds[0])  # creates caches on first use
    counts: Counter[tuple[str, str]] = Counter()
    failures: list[str] = []
    end = time.perf_counter() + seconds
    with Progress(console=console, transient=True, disable=console is None) as progress:
        task = progress.add_task("inputs", total=inputs)
        number = first
        while (inputs is None or number < first + inputs) and time.perf_counter() < end:
            rng = np.random.default_rng([seed, number])
            kind = chosen[int(rng.choice(len(chosen), p=shares / shares.sum()))]
            content = damaged(kind, rng)
            outside = _listing(folder, kind.path.parent)
            outcome, text = read(kind, content)
            if outcome == "slow":  # repeated, since a busy machine may have delayed it
                outcome, text = read(kind, content)
            if new := _listing(folder, kind.path.parent) ^ outside:
                outcome, text = LEFT, repr(sorted(new)[:3])
            counts[kind.name, outcome] += 1
            if outcome in BAD:
                failures.append(f"input {number}, {kind.name}: {outcome}: {text}")
            number += 1
            progress.update(task, completed=number - first)
    return counts, failures


def damaged(kind: Kind, rng: np.random.Generator) -> bytes:
    """Return one of the kind's valid files with one to four random changes."""
    content = bytearray(kind.seeds[rng.integers(len(kind.seeds))])
    for _ in range(rng.integers(1, 5)):
        start, stop = sorted(rng.integers(0, len(content) + 1, 2).tolist())
        stop = min(stop, start + 64)
        change = rng.integers(8)
        if change == 0 and content:
            content[start % len(content)] ^= 1 << int(rng.integers(8))
        elif change == 1 and content:
            content[start % len(content)] = int(rng.integers(256))
        elif change == 2:
            del content[start:stop]
        elif change == 3:
            content[start:start] = content[start:stop] * int(rng.integers(1, 20))
        elif change == 4:
            del content[stop:]
        elif change == 5:
            other = kind.seeds[rng.integers(len(kind.seeds))]
            content[start:stop] = other[start:stop]
        elif change == 6 and (numbers := list(_NUMBER.finditer(content))):
            match = numbers[rng.integers(len(numbers))]
            content[match.start() : match.end()] = _WORDS[rng.integers(len(_WORDS))]
        else:
            content[start : start + int(rng.integers(2))] = _WORDS[rng.integers(len(_WORDS))]
    return bytes(content)


def read(kind: Kind, content: bytes) -> tuple[str, str]:
    """Read `content` as a file of a kind; return the outcome, and a description if it is wrong."""
    kind.path.parent.mkdir(exist_ok=True)
    kind.path.write_bytes(content)
    start = time.perf_counter()
    try:
        with _alarm(), warnings.catch_warnings():
            warnings.simplefilter("error", RuntimeWarning)  # NumPy's, of sums that overflow
            result = kind.read(kind.path)
    except AscaError:
        outcome, text = "refused", ""
    except _Slow:
        return "slow", f"no answer in {SLOW_S:g} s"
    except Exception:
        return "traceback", traceback.format_exc()[-600:]
    else:
        outcome, text = _judge(kind, result, len(content))
    if (took := time.perf_counter() - start) > SLOW_S:
        return "slow", f"{took:.1f} s"
    return outcome, text


def _judge(kind: Kind, result: Any, size: int) -> tuple[str, str]:
    if not _finite(result):
        return "not finite", repr(result)[:200]
    # The densest is a compressed PCD of three bytes a point, of which three bytes of LZF give 264.
    if kind.is_scan and len(result) > 88 * size:
        return "too many points", f"{len(result)} of {size} bytes"
    return "read", ""


def _finite(value: Any) -> bool:
    if isinstance(value, np.ndarray):
        return bool(np.isfinite(value).all())
    if isinstance(value, dict):
        return all(map(_finite, value.values()))
    if isinstance(value, (list, tuple)):
        return all(map(_finite, value))
    return not isinstance(value, float) or math.isfinite(value)


def _listing(folder: Path, target: Path) -> set[tuple[str, int]]:
    """Return every file below a folder with its size, except those below `target`."""
    found = set()
    for at, names, files in os.walk(folder):
        names[:] = [name for name in names if Path(at, name) != target]
        found |= {(f"{at}/{name}", Path(at, name).lstat().st_size) for name in files}
    return found


@contextmanager
def _alarm() -> Iterator[None]:
    """Raise `_Slow` after SLOW_S."""

    def ring(_number: int, _frame: FrameType | None) -> None:
        raise _Slow

    before = signal.signal(signal.SIGALRM, ring)
    signal.setitimer(signal.ITIMER_REAL, SLOW_S)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGALRM, before)


if __name__ == "__main__":
    run_command(main)
