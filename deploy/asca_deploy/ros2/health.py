"""Health of a node: counters and latencies, as a line of its log, as diagnostics, and as word to systemd."""

import os
import socket
import threading
from collections import Counter, deque
from collections.abc import Mapping
from dataclasses import dataclass, field
from time import monotonic
from typing import Any

import numpy as np

from asca_deploy.ros2.messages import ERROR, OK, WARN

_QUIET_S = 2.0
"""Seconds without a message after which diagnostics warn."""
_MOST_LATENCIES = 10_000


@dataclass
class Health:
    """Counters since the start; thread-safe."""

    received: int = 0
    """Messages of the topic."""
    answered: int = 0
    dropped: int = 0
    """Scans dropped in favor of later ones before the detector was free."""
    lost: int = 0
    """Messages reported lost by the middleware."""
    unreadable: int = 0
    error_text: str | None = None
    """Reason why the last unreadable one could not be read."""
    warnings: tuple[str, ...] = ()
    """Warnings of the last answered scan."""
    failure: str | None = None
    """Reason why the detector ended."""
    latencies_ms: deque[float] = field(default_factory=lambda: deque(maxlen=_MOST_LATENCIES))
    """Times from a message's arrival to its answer, of the scans since the last `summary`."""
    boxes: Counter[str] = field(default_factory=Counter)
    """Boxes by class, of the same scans."""
    _last_message_s: float = field(default_factory=monotonic)
    _since: tuple[float, int] = field(default_factory=lambda: (monotonic(), 0))
    _last_reported: tuple[int, int, int] = (0, 0, 0)
    _lock: threading.Lock = field(default_factory=threading.Lock)

    def count_received(self) -> None:
        """Count a received message."""
        with self._lock:
            self.received += 1
            self._last_message_s = monotonic()

    def count_unreadable(self, why: str) -> None:
        """Count a message that could not be read."""
        with self._lock:
            self.unreadable += 1
            self.error_text = why

    def count_answered(self, latency_ms: float, names: list[str], warnings: tuple[str, ...]) -> None:
        """Count a scan answered with boxes of these classes."""
        with self._lock:
            self.answered += 1
            self.latencies_ms.append(latency_ms)
            self.boxes.update(names)
            self.warnings = warnings

    def summary(self) -> dict[str, Any]:
        """Return the events since the last call, and the counters since the start."""
        with self._lock:
            now, (since, answered) = monotonic(), self._since
            self._since = now, self.answered
            figures: dict[str, Any] = {
                "received": self.received,
                "answered": self.answered,
                "dropped": self.dropped,
                "lost": self.lost,
                "unreadable": self.unreadable,
                "answers_per_s": round((self.answered - answered) / max(now - since, 1e-9), 2),
            }
            if self.latencies_ms:
                p50, p95, p99 = np.percentile(np.array(self.latencies_ms), [50, 95, 99])
                latest = {"p50": p50, "p95": p95, "p99": p99, "max": max(self.latencies_ms)}
                figures["latency_ms"] = {name: round(float(value), 1) for name, value in latest.items()}
            figures["boxes"] = dict(self.boxes)
            self.latencies_ms.clear()
            self.boxes.clear()
            return figures

    def status(self, topic: str, publishers: int) -> tuple[int, str]:
        """Return a level of diagnostics and a sentence about the time since the last call."""
        with self._lock:
            before, self._last_reported = self._last_reported, (self.dropped, self.lost, self.unreadable)
            dropped, lost, unreadable = (now - then for now, then in zip(self._last_reported, before, strict=True))
            quiet_s = monotonic() - self._last_message_s
            if self.failure:
                return ERROR, self.failure
            if not publishers:
                return WARN, f"nobody publishes {topic}"
            if quiet_s > _QUIET_S:
                return WARN, f"no scan on {topic} for {quiet_s:.0f} s"
            if unreadable:
                return WARN, f"{unreadable} scans could not be read: {self.error_text}"
            if dropped or lost:
                return WARN, f"{dropped} scans dropped for later ones, {lost} lost on the way"
            if self.warnings:
                return WARN, self.warnings[0]
            return OK, "every scan is answered"


class Systemd:
    """Notifications (sd_notify(3)) to the socket that systemd names in the environment; without one nothing is sent.

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
