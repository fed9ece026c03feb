"""How this package was installed, what came along, the commands that add to it, and what dependencies may report."""

import importlib.util
import os
import shlex
from pathlib import Path

_PROJECT = 'name = "asca-pillars"'


def source_tree() -> Path | None:
    """The source tree that this code runs from; None where a wheel was installed."""
    root = Path(__file__).parents[2]
    try:
        text = (root / "pyproject.toml").read_text(encoding="utf-8")
    except (OSError, ValueError):
        return None
    return root if _PROJECT in text.splitlines() else None


def install_command(extra: str) -> str:
    """The command that adds what an extra needs, such as `pip install 'asca-pillars[train]'`.

    Neither form needs the package to be on an index: of a wheel that is installed pip reads the requirements where it
    lies.
    """
    root = source_tree()
    if root is None:
        return f"pip install 'asca-pillars[{extra}]'"
    return f"pip install -e {shlex.quote(f'{root}[{extra}]')}"


def upgrade_advice() -> str:
    """How to get a newer version."""
    root = source_tree()
    return "install a newer asca-pillars" if root is None else f"upgrade with `git -C {shlex.quote(str(root))} pull`"


def shipped_bundles() -> dict[str, Path]:
    """Folders of the bundles that come with the runtime, by name; the runtime is not imported."""
    runtime = importlib.util.find_spec("asca_deploy")
    places = [] if runtime is None else runtime.submodule_search_locations or []
    return {path.parent.name: path.parent for place in places for path in Path(place).glob("bundles/*/bundle.json")}


_SWITCHES = {"ORT_DISABLE_TELEMETRY": "1", "RAY_USAGE_STATS_ENABLED": "0"}
_YES = ("1", "true", "yes", "on")  # in onnxruntime's reading


def disable_telemetry() -> None:
    """Refuse the reports of all dependencies, in the environment; what the user has set there stays."""
    for name, value in _SWITCHES.items():
        os.environ[name] = os.environ.get(name) or value


def onnxruntime_may_report() -> bool:
    """Whether the user wants onnxruntime's reports: ORT_DISABLE_TELEMETRY is set to 0."""
    return os.environ["ORT_DISABLE_TELEMETRY"].lower() not in _YES
