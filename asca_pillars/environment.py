"""What a result depends on beside its inputs: machine, versions, source revision."""

import importlib.metadata
import json
import platform
import subprocess
import sys
from pathlib import Path

from asca_pillars.machine import cpu_model

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


def git_revision() -> str | None:
    """Revision of the source checkout this code runs from, `-dirty` if it was changed; None when installed."""
    root = Path(__file__).parent.parent
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


def package_versions() -> dict[str, str]:
    """Versions of Python and of the installed packages that a result depends on."""
    versions = {"python": platform.python_version()}
    for package in PACKAGES:
        try:
            versions[package] = importlib.metadata.version(package)
        except importlib.metadata.PackageNotFoundError:
            continue
    return versions


def command_line() -> str:
    """The command as it was typed, without the folder of the program."""
    return " ".join([Path(sys.argv[0]).name, *sys.argv[1:]])


def describe_environment() -> str:
    """JSON text of all of it, to be saved beside a result."""
    description = {
        "command": command_line(),
        "git_revision": git_revision(),
        "platform": platform.platform(),
        "cpu": cpu_model(),
        "packages": package_versions(),
    }
    return json.dumps(description, indent=2) + "\n"
