"""Time stamps of the scans of a folder: at a constant rate, or from a file."""

from collections.abc import Sequence
from decimal import Decimal, InvalidOperation
from pathlib import Path

from asca_pillars.base.errors import ConfigError, ScanError
from asca_pillars.base.input_files import read_text

RATE_HZ = 10.0
"""Default rate of scans."""
_MAX_RATE_HZ = 1000.0
_MAX_TIME_S = 9_000_000_000  # in 2255; larger numbers are not seconds


def require_one_folder(paths: Sequence[Path]) -> None:
    """Refuse scans of several folders, whose order in time is unknown, with a ConfigError."""
    if len(folders := sorted({path.parent for path in paths})) > 1:
        raise ConfigError(
            f"{folders[0]} and {folders[1]}: with --track, --rate, --times, --foxglove or --rerun scans lie in one "
            "folder, in the order of their times; give one of these"
        )


def scan_times_ns(count: int, rate_hz: float | None = None, times: Path | None = None) -> list[int]:
    """Return the time of each of `count` scans, nanoseconds, ascending; with a rate, they begin at 0.

    Args:
        count: number of scans.
        rate_hz: scans per second; None: RATE_HZ.
        times: text file with the seconds of each scan, one per line.

    Raises:
        ConfigError: the rate is invalid, or both are given.
        ScanError: the file cannot be read, has another number of times, or they do not ascend.
    """
    if times is None:
        rate = RATE_HZ if rate_hz is None else rate_hz
        if not 0 < rate <= _MAX_RATE_HZ:
            raise ConfigError(f"--rate {rate:g}: give scans per second, above 0 and at most {_MAX_RATE_HZ:g}")
        return [round(number * 1e9 / rate) for number in range(count)]
    if rate_hz is not None:
        raise ConfigError(f"--rate {rate_hz:g} and --times {times}: give one of them")
    stamps = _read_times(times)
    if len(stamps) != count:
        raise ScanError(f"{times}: {len(stamps)} times for {count} scans; list one for each, in their order")
    return stamps


def _read_times(path: Path) -> list[int]:
    try:
        lines = read_text(path, ScanError).split("\n")
    except OSError as error:
        raise ScanError(f"{path}: cannot be read ({error.strerror or error}); check the path") from None
    except UnicodeDecodeError:
        raise ScanError(f"{path}: is not text; list the seconds of each scan, one in a line") from None
    stamps: list[int] = []
    for number, line in enumerate(lines, start=1):
        if not (text := line.strip()):
            continue
        try:
            seconds = Decimal(text)  # a float has too few digits for the nanoseconds of a clock
        except InvalidOperation:
            seconds = Decimal("NaN")
        if seconds.is_nan() or not 0 <= seconds <= _MAX_TIME_S:
            raise ScanError(f"{path}:{number}: {text[:40]!r} is not a time; give seconds, 0 or more")
        time_ns = round(seconds * 1_000_000_000)
        if stamps and time_ns <= stamps[-1]:
            raise ScanError(f"{path}:{number}: {text[:40]} is not after the time before it; list times that ascend")
        stamps.append(time_ns)
    return stamps
