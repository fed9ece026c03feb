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


def test_quota_of_cgroup_v2_is_the_smallest_on_the_way_up(tmp_path: Path) -> None:
    write(tmp_path / "proc/self/cgroup", "0::/pod/job\n")
    write(tmp_path / "cgroup/pod/job/cpu.max", "max 100000\n")
    write(tmp_path / "cgroup/pod/cpu.max", "250000 100000\n")
    assert system.cpu_quota(tmp_path / "proc", tmp_path / "cgroup") == 2.5


def test_quota_of_cgroup_v1(tmp_path: Path) -> None:
    write(tmp_path / "proc/self/cgroup", "9:memory:/job\n4:cpu,cpuacct:/job\n0::/\n")
    write(tmp_path / "cgroup/cpu,cpuacct/job/cpu.cfs_quota_us", "300000\n")
    write(tmp_path / "cgroup/cpu,cpuacct/job/cpu.cfs_period_us", "100000\n")
    write(tmp_path / "cgroup/cpu,cpuacct/cpu.cfs_quota_us", "-1\n")
    write(tmp_path / "cgroup/cpu,cpuacct/cpu.cfs_period_us", "100000\n")
    assert system.cpu_quota(tmp_path / "proc", tmp_path / "cgroup") == 3.0


def test_quota_in_a_container_that_sees_the_hosts_path(tmp_path: Path) -> None:
    write(tmp_path / "proc/self/cgroup", "0::/host/only/path\n")
    write(tmp_path / "cgroup/cpu.max", "150000 100000\n")
    assert system.cpu_quota(tmp_path / "proc", tmp_path / "cgroup") == 1.5


def test_no_quota(tmp_path: Path) -> None:
    assert system.cpu_quota(tmp_path, tmp_path) == math.inf
    write(tmp_path / "self/cgroup", "0::/\n")
    write(tmp_path / "cpu.max", "max 100000\n")
    assert system.cpu_quota(tmp_path, tmp_path) == math.inf


@pytest.mark.parametrize(("quota", "threads"), [(math.inf, 4), (2.9, 2), (0.5, 1), (64.0, 4)])
def test_default_threads(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, quota: float, threads: int) -> None:
    write(tmp_path / "cpuinfo", HYPERTHREADED)
    monkeypatch.setattr(system, "PROC", tmp_path)
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: set(range(8)), raising=False)
    monkeypatch.setattr(system, "cpu_quota", lambda: quota)
    assert system.default_threads() == threads


def test_default_threads_elsewhere(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(system, "PROC", tmp_path / "none")
    monkeypatch.setattr(os, "cpu_count", lambda: 6)
    assert system.default_threads() == 6


def test_cpu_model(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert system.cpu_model()
    write(tmp_path / "cpuinfo", HYPERTHREADED)
    monkeypatch.setattr(system, "PROC", tmp_path)
    assert system.cpu_model() == "Example 9000"
