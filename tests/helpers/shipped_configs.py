"""The configurations that ship."""

from pathlib import Path

CONFIGS = sorted((Path(__file__).parents[2] / "configs").glob("*.yaml"))
