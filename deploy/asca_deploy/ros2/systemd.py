"""Notifications of systemd (sd_notify(3)): the service is ready, alive, stopping."""

import os
import socket
from collections.abc import Mapping


class Systemd:
    """The socket that systemd names in the environment; without one nothing is sent.

    Attributes:
        watchdog_s: seconds after which systemd restarts a service that did not say that it lives; None: it does not
            watch.
    """

    def __init__(self, environment: Mapping[str, str] | None = None) -> None:
        environment = os.environ if environment is None else environment
        self._address = environment.get("NOTIFY_SOCKET", "")
        microseconds, pid = environment.get("WATCHDOG_USEC", ""), environment.get("WATCHDOG_PID", "")
        is_watched = self._address and microseconds.isdecimal() and pid in ("", str(os.getpid()))
        self.watchdog_s = int(microseconds) / 1e6 if is_watched and int(microseconds) else None

    def ready(self, status: str) -> None:
        """Notify that the service is ready; `status` is what `systemctl status` shows."""
        self._send("READY=1", f"STATUS={status}")

    def alive(self, status: str) -> None:
        """Notify that the service is alive."""
        self._send("WATCHDOG=1", f"STATUS={status}")

    def stopping(self) -> None:
        """Notify that the service is stopping."""
        self._send("STOPPING=1")

    def _send(self, *lines: str) -> None:
        if not self._address:
            return
        address = f"\0{self._address[1:]}" if self._address.startswith("@") else self._address
        try:
            with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_CLOEXEC) as sender:
                sender.sendto("\n".join(lines).encode(), address)
        except OSError:  # nobody listens any more: the service goes on
            pass
