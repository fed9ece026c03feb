"""A service tells systemd that it is ready, lives and stops, if systemd listens."""

import os
import socket
from pathlib import Path

import pytest

from asca_deploy.ros2.health import Systemd


@pytest.mark.parametrize("is_abstract", [False, True])
def test_messages_arrive_on_the_socket(tmp_path: Path, is_abstract: bool) -> None:
    name = f"asca-{os.getpid()}" if is_abstract else str(tmp_path / "notify")
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as listener:
        listener.bind(f"\0{name}" if is_abstract else name)
        environment = {"NOTIFY_SOCKET": f"@{name}" if is_abstract else name, "WATCHDOG_USEC": "3000000"}
        systemd = Systemd(environment)
        systemd.ready("warmed up")
        systemd.alive("5 scans")
        systemd.stopping()
        heard = [listener.recv(1000).decode().splitlines() for _ in range(3)]
    assert heard == [["READY=1", "STATUS=warmed up"], ["WATCHDOG=1", "STATUS=5 scans"], ["STOPPING=1"]]
    assert systemd.watchdog_s == 3.0


def test_without_systemd_nothing_is_sent(tmp_path: Path) -> None:
    assert Systemd({}).watchdog_s is None
    Systemd({}).ready("well")
    Systemd({"NOTIFY_SOCKET": str(tmp_path / "nobody")}).alive("well")


def test_a_watchdog_of_another_process_or_without_time_is_none() -> None:
    for usec, pid in (("1000000", "1"), ("0", ""), ("soon", "")):
        environment = {"NOTIFY_SOCKET": "/nowhere", "WATCHDOG_USEC": usec, "WATCHDOG_PID": pid}
        assert Systemd(environment).watchdog_s is None
