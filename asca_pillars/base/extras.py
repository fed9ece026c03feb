"""Optional extras of the installation, and the error when one is missing."""

import importlib.util

from asca_pillars.base.errors import AscaError
from asca_pillars.base.installation import install_command

EXTRAS = {
    "train": ("torch", "lightning", "onnx", "onnxscript", "tensorboard"),
    "openvino": ("openvino",),
    "eval": ("matplotlib",),
    "import": ("pyarrow",),
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
