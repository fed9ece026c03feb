"""Memory of the process."""

import sys
from pathlib import Path

STATUS = Path("/proc/self/status")


def peak_memory_mib() -> float | None:
    """Return the largest resident memory of the process so far; None if the system does not report it.

    Linux keeps the figure of getrusage across exec, which is too large for a small program started by a large one;
    /proc is correct.
    """
    if (peak := _status_mib("VmHWM")) is not None:
        return peak
    if sys.platform == "win32":
        return None
    import resource  # does not exist on Windows

    largest = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return float(largest / 2**20 if sys.platform == "darwin" else largest / 2**10)  # bytes there, KiB elsewhere


def resident_mib() -> float | None:
    """Return the resident memory of the process now; None if the system does not report it."""
    return _status_mib("VmRSS")


def _status_mib(key: str) -> float | None:
    try:
        lines = STATUS.read_text().splitlines()
    except OSError:
        return None
    return next((int(line.split()[1]) / 2**10 for line in lines if line.startswith(f"{key}:")), None)
