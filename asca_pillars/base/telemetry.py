"""Telemetry of dependencies, disabled before they are imported.

onnxruntime reports from 1.32 on, from its import on: it leaves a lasting identifier in the home folder and looks a host
up. Ray reports where nobody has refused. Both read the environment, and hand it on to the processes that they start.
"""

import os

_SWITCHES = {"ORT_DISABLE_TELEMETRY": "1", "RAY_USAGE_STATS_ENABLED": "0"}
_YES = ("1", "true", "yes", "on")  # in onnxruntime's reading


def disable_telemetry() -> None:
    """Refuse the reports of all dependencies, in the environment; what the user has set there stays."""
    for name, value in _SWITCHES.items():
        os.environ[name] = os.environ.get(name) or value


def onnxruntime_may_report() -> bool:
    """Return whether the user enables onnxruntime's reports: ORT_DISABLE_TELEMETRY is set to 0."""
    return os.environ["ORT_DISABLE_TELEMETRY"].lower() not in _YES
