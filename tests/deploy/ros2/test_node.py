"""`asca ros2` with a real ROS 2: another process publishes, and gets boxes back.

ROS' discovery stays on this machine. Needs an environment of its own: tests/requirements-ros2.txt.
"""

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("rclpy", reason="needs ROS 2: pip install -r tests/requirements-ros2.txt")

ROOT = Path(__file__).parents[3]
SMALL = 10_000
"""Points whose message fits into the middleware's buffers, so that best effort loses none."""


@pytest.fixture
def environment() -> dict[str, str]:
    domain = str(1 + os.getpid() % 100)
    return os.environ | {"ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST", "ROS_DOMAIN_ID": domain, "OMP_NUM_THREADS": "1"}


@contextmanager
def node(environment: dict[str, str], *arguments: str) -> Iterator[subprocess.Popen[str]]:
    """The node, ready."""
    command = [sys.executable, "-m", "asca_pillars.cli", "ros2", "--topic", "/points", *arguments]
    with subprocess.Popen(command, env=environment, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True) as one:
        assert one.stdout is not None
        lines: list[str] = []
        for line in one.stdout:
            lines.append(line)
            if '"ready"' in line:
                break
        else:
            pytest.fail("".join(lines))
        try:
            yield one
        finally:
            one.kill()


def published(environment: dict[str, str], kind: str, count: int, points: int = SMALL) -> dict[str, Any]:
    command = [sys.executable, "-m", "benchmarks.ros2_publisher", "--qos", kind.lower()]
    command += ["--count", str(count), "--points", str(points)]
    result = subprocess.run(command, env=environment, cwd=ROOT, capture_output=True, text=True, timeout=90, check=True)
    return json.loads(result.stdout)


def ended(process: subprocess.Popen[str], kind: signal.Signals) -> tuple[list[dict[str, Any]], float]:
    """The lines of the log after `ready`, and seconds from the signal to the end."""
    start = time.monotonic()
    process.send_signal(kind)
    output, _ = process.communicate(timeout=20)
    seconds = time.monotonic() - start
    assert process.returncode == 0, output
    assert "Traceback" not in output
    lines = [line for line in output.splitlines() if line.startswith("{")]  # the others are ROS' own
    return [json.loads(line) for line in lines], seconds


@pytest.mark.parametrize("kind", ["RELIABLE", "BEST_EFFORT"])
def test_every_scan_of_both_kinds_of_publisher_is_answered(environment: dict[str, str], kind: str) -> None:
    with node(environment, "--bundle", "fast") as process:
        heard = published(environment, kind, 10)
        log, seconds = ended(process, signal.SIGINT)
    numbers = [number for number, _ in heard["answers"]]
    assert numbers == sorted(set(numbers)) and {frame for _, frame in heard["answers"]} == {"lidar"}
    assert heard["statuses"]
    (subscribed,) = (line for line in log if line["event"] == "subscribed")
    assert subscribed["reliability"] == kind.lower()
    end = log[-1]
    assert (end["received"], end["lost"], end["unreadable"]) == (10, 0, 0)
    assert end["answered"] == len(numbers) == 10 - end["dropped"]  # none is dropped where the machine is idle
    assert seconds < 3  # of a busy machine; 0.1 s of an idle one


def test_a_publisher_that_dies_and_another_kind_that_comes(environment: dict[str, str]) -> None:
    with node(environment, "--track", "--bundle", "fast") as process:
        first, second = published(environment, "RELIABLE", 3), published(environment, "BEST_EFFORT", 3)
        log, _ = ended(process, signal.SIGTERM)
    assert first["answers"] and second["answers"]
    assert [line["reliability"] for line in log if line["event"] == "subscribed"] == ["reliable", "best_effort"]
    assert log[-1]["event"] == "end" and log[-1]["received"] == 6
