import math
import os
from pathlib import Path

import pytest

from asca_pillars.base import system


def cpuinfo(*cores: tuple[int, int]) -> str:
    """/proc/cpuinfo of CPUs that sit on the cores (socket, core)."""
    return "\n".join(
        f"processor\t: {cpu}\nmodel name\t: Example 9000\nphysical id\t: {socket}\ncore id\t\t: {core}\n"
        for cpu, (socket, core) in enumerate(cores)
    )


HYPERTHREADED = cpuinfo((0, 0), (0, 1), (1, 0), (1, 1), (0, 0), (0, 1), (1, 0), (1, 1))
ARM = "\n".join(f"processor\t: {cpu}\nBogoMIPS\t: 50.00\nCPU part\t: 0xd40\n" for cpu in range(4))


@pytest.mark.parametrize(
    ("text", "allowed", "cores"),
    [
        (HYPERTHREADED, set(range(8)), 4),
        (HYPERTHREADED, {0, 4}, 1),  # two threads of one core
        (HYPERTHREADED, {0, 2}, 2),  # core 0 of either socket
        (ARM, {0, 1, 3}, 3),
        ("", {0, 1}, 2),
    ],
)
def test_physical_cores(text: str, allowed: set[int], cores: int) -> None:
    assert system.physical_cores(text, allowed) == cores


def write(path: Path, text: str) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text)


QUOTAS = {
    "the smallest on the way up": (
        "0::/pod/job\n",
        {"pod/job/cpu.max": "max 100000\n", "pod/cpu.max": "250000 100000\n"},
        2.5,
    ),
    "version 1": (
        "9:memory:/job\n4:cpu,cpuacct:/job\n0::/\n",
        {
            "cpu,cpuacct/job/cpu.cfs_quota_us": "300000\n",
            "cpu,cpuacct/job/cpu.cfs_period_us": "100000\n",
            "cpu,cpuacct/cpu.cfs_quota_us": "-1\n",
            "cpu,cpuacct/cpu.cfs_period_us": "100000\n",
        },
        3.0,
    ),
    "a container that sees the host's path": ("0::/host/only/path\n", {"cpu.max": "150000 100000\n"}, 1.5),
    "no limit": ("0::/\n", {"cpu.max": "max 100000\n"}, math.inf),
}


@pytest.mark.parametrize("case", QUOTAS)
def test_quota_of_cgroups(tmp_path: Path, case: str) -> None:
    groups, files, quota = QUOTAS[case]
    assert system.cpu_quota(tmp_path / "proc", tmp_path / "cgroup") == math.inf
    write(tmp_path / "proc/self/cgroup", groups)
    for name, text in files.items():
        write(tmp_path / "cgroup" / name, text)
    assert system.cpu_quota(tmp_path / "proc", tmp_path / "cgroup") == quota


@pytest.mark.parametrize(("quota", "threads"), [(math.inf, 4), (2.9, 2), (0.5, 1), (64.0, 4)])
def test_default_threads(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, quota: float, threads: int) -> None:
    write(tmp_path / "cpuinfo", HYPERTHREADED)
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: set(range(8)), raising=False)
    monkeypatch.setattr(system, "cpu_quota", lambda: quota)
    assert system.cpu_model()
    monkeypatch.setattr(system, "PROC", tmp_path)
    assert (system.default_threads(), system.cpu_model()) == (threads, "Example 9000")
    monkeypatch.setattr(system, "PROC", tmp_path / "none")
    monkeypatch.setattr(os, "cpu_count", lambda: 6)
    assert system.default_threads() == 6, "elsewhere"
