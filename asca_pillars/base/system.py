"""Properties of the computer and the software that results depend on: granted cores, versions, source revision."""

import functools
import importlib.metadata
import math
import os
import platform
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from asca_pillars.base.errors import ConfigError

PROC = Path("/proc")
CGROUP = Path("/sys/fs/cgroup")
PACKAGES = (
    "asca-pillars",
    "numpy",
    "onnx",
    "onnxruntime",
    "onnxscript",
    "openvino",
    "opencv-python-headless",
    "torch",
    "lightning",
)


def default_threads() -> int:
    """Return the physical cores granted to this process: its CPU affinity, its control group's quota, at least 1.

    Two hardware threads of one core share the arithmetic units that a network keeps busy, so that a second
    thread per core brings waiting, not speed. A quota is rounded down: a thread that only gets part of its
    time makes all others wait for it.
    """
    try:
        cpuinfo = (PROC / "cpuinfo").read_text()
        allowed = os.sched_getaffinity(0)
    except (OSError, AttributeError):  # not Linux
        return os.cpu_count() or 1
    return max(1, min(physical_cores(cpuinfo, allowed), math.floor(min(cpu_quota(), 1e6))))


def check_threads(threads: int | None) -> int:
    """Return the number of CPU threads to use: the given one, or `default_threads` for None.

    Raises:
        ConfigError: it is not a whole number, less than one, or more than four for each CPU of the machine, which
            only wait for each other.
    """
    if threads is None:
        return default_threads()
    cpus = os.cpu_count() or 1
    if not isinstance(threads, int) or not 1 <= threads <= 4 * cpus:
        raise ConfigError(f"threads {threads} must lie between 1 and {4 * cpus}: this machine has {cpus} CPUs")
    return threads


def physical_cores(cpuinfo: str, allowed: set[int]) -> int:
    """Count the physical cores among the logical CPUs `allowed`, by the text of /proc/cpuinfo.

    A CPU whose core is not named there (ARM, some virtual machines) counts as a core of its own.
    """
    cores: set[tuple[str, str]] = set()
    for cpu in _cpuinfo_blocks(cpuinfo):
        number = cpu.get("processor", "")
        if number.isdecimal() and int(number) in allowed:
            cores.add((cpu.get("physical id", ""), cpu.get("core id", f"cpu {number}")))
    return len(cores) or len(allowed)


def cpu_quota(proc: Path = PROC, cgroup: Path = CGROUP) -> float:
    """Return CPUs' worth of time that the control groups (v1 or v2, and their parents) grant; inf if unlimited."""
    quota = math.inf
    for line in _read(proc / "self" / "cgroup").splitlines():
        _, controllers, path = line.split(":", 2)
        if controllers == "":
            mounts = [cgroup, cgroup / "unified"]
        elif "cpu" in controllers.split(","):
            mounts = [cgroup / "cpu", cgroup / "cpu,cpuacct"]
        else:
            continue
        for mount in mounts:
            group = mount / path.lstrip("/")
            # In a container `path` may be the host's and not exist here; then the mount holds the limit.
            for folder in (group, *group.parents):
                if folder.is_relative_to(mount):
                    quota = min(quota, _limit(folder))
    return quota


def cpu_model() -> str:
    """Return the name of the processor as the operating system gives it."""
    for cpu in _cpuinfo_blocks(_read(PROC / "cpuinfo")):
        for key in ("model name", "Model", "Hardware"):
            if key in cpu:
                return cpu[key]
    return platform.processor() or platform.machine()


def git_revision() -> str | None:
    """Return the revision of the source checkout of this code, `-dirty` if it was changed; None when installed."""
    root = Path(__file__).parents[2]
    try:
        run = subprocess.run(
            ["git", "describe", "--always", "--dirty", "--abbrev=12"],
            cwd=root,
            capture_output=True,
            text=True,
        )
    except OSError:
        return None
    return run.stdout.strip() if run.returncode == 0 and (root / ".git").exists() else None


@functools.cache
def own_version() -> str:
    """Return the version of asca-pillars; "unknown" where it is run without being installed."""
    try:
        return importlib.metadata.version("asca-pillars")
    except importlib.metadata.PackageNotFoundError:
        return "unknown"


def package_versions() -> dict[str, str]:
    """Return versions of Python and of the installed packages that a result depends on."""
    versions = {"python": platform.python_version()}
    for package in PACKAGES:
        try:
            versions[package] = importlib.metadata.version(package)
        except importlib.metadata.PackageNotFoundError:
            continue
    return versions


def command_line() -> str:
    """Return the command as it was typed, without the folder of the program."""
    return " ".join([Path(sys.argv[0]).name, *sys.argv[1:]])


def describe_environment() -> dict[str, Any]:
    """Return the environment of the process as plain values, to be saved beside a result."""
    return {
        "command": command_line(),
        "git_revision": git_revision(),
        "platform": platform.platform(),
        "cpu": cpu_model(),
        "packages": package_versions(),
    }


def _limit(group: Path) -> float:
    if both := _read(group / "cpu.max").split():  # v2: "200000 100000" or "max 100000"
        quota, period = both[0], both[-1]
    else:  # v1: two files, -1 for no limit
        quota, period = _read(group / "cpu.cfs_quota_us").strip(), _read(group / "cpu.cfs_period_us").strip()
    if quota.isdecimal() and period.isdecimal() and int(period) > 0:
        return int(quota) / int(period)
    return math.inf


def _cpuinfo_blocks(cpuinfo: str) -> Iterator[dict[str, str]]:
    for block in cpuinfo.strip().split("\n\n"):
        pairs = (line.split(":", 1) for line in block.splitlines() if ":" in line)
        yield {key.strip(): value.strip() for key, value in pairs}


def _read(path: Path) -> str:
    try:
        return path.read_text()
    except OSError:
        return ""
