"""The installation of this package: its source tree, its bundles, and its optional extras."""

import importlib.util
import shlex
from pathlib import Path

from asca_pillars.base.errors import AscaError

_PROJECT = 'name = "asca-pillars"'
_FORMER_NAMES = {
    "asca_sim_int8": "default",
    "asca_sim": "default_float32",
    "asca_small_sparse_sim_int8": "fast",
    "asca_refine_sim_int8": "accurate",
}


def source_tree() -> Path | None:
    """Return the source tree that this code runs from; None where a wheel was installed."""
    root = Path(__file__).parents[2]
    try:
        text = (root / "pyproject.toml").read_text(encoding="utf-8")
    except (OSError, ValueError):
        return None
    return root if _PROJECT in text.splitlines() else None


def install_command(extra: str) -> str:
    """Return the command that adds what an extra needs, such as `pip install 'asca-pillars[train]'`.

    Neither form needs the package to be on an index: of a wheel that is installed pip reads the requirements where it
    lies.
    """
    root = source_tree()
    if root is None:
        return f"pip install 'asca-pillars[{extra}]'"
    return f"pip install -e {shlex.quote(f'{root}[{extra}]')}"


def upgrade_advice() -> str:
    """Return the advice to install a newer version."""
    root = source_tree()
    return "install a newer asca-pillars" if root is None else f"upgrade with `git -C {shlex.quote(str(root))} pull`"


def shipped_models() -> dict[str, Path]:
    """Return the folders of bundles and weights that come with the runtime, by name; the runtime is not imported."""
    runtime = importlib.util.find_spec("asca_deploy")
    places = [] if runtime is None else runtime.submodule_search_locations or []
    return {path.name: path for place in places for path in sorted(Path(place).glob("bundles/*")) if path.is_dir()}


def find_shipped(name: str) -> Path | None:
    """Return the folder of a model that ships, by its name or one that it had before; None if there is none."""
    return shipped_models().get(_FORMER_NAMES.get(name, name))


EXTRAS = {
    "train": ("torch", "lightning", "onnx", "onnxscript", "tensorboard"),
    "openvino": ("openvino",),
    "eval": ("matplotlib",),
    "import": ("pyarrow", "laspy", "lazrs"),
    "recordings": ("rosbags", "mcap"),
    "video": ("imageio_ffmpeg",),
    "view": ("rerun", "rosbags", "mcap"),
    "packets": ("velodyne_decoder", "dpkt", "ouster"),
    "ros2": ("rclpy", "sensor_msgs", "visualization_msgs", "diagnostic_msgs"),
    "cluster": ("ray",),
}


def missing_modules(extra: str) -> list[str]:
    """Return modules of an extra that are not installed."""
    return [name for name in EXTRAS[extra] if importlib.util.find_spec(name) is None]


def require(extra: str) -> None:
    """Raise AscaError that names what to install unless every module of the extra is there."""
    if missing := missing_modules(extra):
        raise AscaError(f"{', '.join(missing)} not installed: {install_command(extra)}")
