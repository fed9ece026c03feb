"""Files in the folder of a run, and the recognition of earlier ones."""

from pathlib import Path

import yaml

from asca_pillars.base.own_files import (
    Recognizer,
    json_object,
    require_not_input,
    require_own,
    starting_with,
    written_by,
)
from asca_pillars.base.settings import parse_yaml

COMMAND = "asca train"
CONFIG_FILE = "config.yaml"
ENVIRONMENT_FILE = "environment.json"
FRAMES_FILE = "frames.json"
EXPECTED_INPUT_FILE = "expected_input.yaml"
LOG_FILE = "train.log"
"""Output of a run that `asca ablate` starts."""
YAML_HEAD = f"# {written_by(COMMAND)}\n"
_IS_ENVIRONMENT = json_object("command", "git_revision", "platform", "packages")
_CONFIG_KEYS = ("name", "model", "data", "augment", "train")
_EXPECTED_INPUT_KEYS = ("points_per_scan", "reflectance_mean", "ground_z_m", "camera_view")


def require_own_run(out: Path, init: str | Path | None = None) -> None:
    """Make sure that a training may write into `out`: it is absent, empty, or the folder of a run.

    A configuration that a user wrote there is not replaced by that of the run.

    Args:
        out: folder of the run.
        init: weights that the run starts from; not among its own checkpoints.

    Raises:
        OutputError: names what is in the way.
    """
    products: dict[str, Recognizer] = {
        CONFIG_FILE: is_own_config,
        ENVIRONMENT_FILE: _IS_ENVIRONMENT,
        FRAMES_FILE: json_object("frames", "frames_sha256", "processes"),
        EXPECTED_INPUT_FILE: is_own_expected_input,
    }
    if (out / LOG_FILE).is_file() and _is_log(out / LOG_FILE):  # others are of the user's shell, and stay
        products[LOG_FILE] = _is_log
    require_own(out, COMMAND, products, folders=("checkpoints", "tensorboard"))
    require_not_input(out / "checkpoints", (init,))


def is_own_config(path: Path) -> bool:
    """Return whether it is the resolved configuration of a run, of older versions as well."""
    return starting_with(YAML_HEAD)(path) or _is_older(path, _CONFIG_KEYS)


def is_own_expected_input(path: Path) -> bool:
    """Return whether it holds what a run measured of its training scans, of older versions as well."""
    return starting_with(YAML_HEAD)(path) or _is_older(path, _EXPECTED_INPUT_KEYS)


def _is_older(path: Path, keys: tuple[str, ...]) -> bool:
    """Return whether it is a file of an older version without its origin: in a run's folder, plain, with every key."""
    environment = path.with_name(ENVIRONMENT_FILE)
    if not environment.is_file() or not _IS_ENVIRONMENT(environment):
        return False
    try:
        text = path.read_text(encoding="utf-8")
        content = parse_yaml(text)
    except (ValueError, yaml.YAMLError):
        return False
    commented = any(line.lstrip().startswith("#") for line in text.splitlines())
    return not commented and isinstance(content, dict) and all(key in content for key in keys)


def _is_log(path: Path) -> bool:
    return path.stat().st_size == 0 or starting_with(written_by("asca ablate"))(path)
