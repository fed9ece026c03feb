"""What to simulate, read from a YAML file."""

from dataclasses import replace

from asca_pillars.base.schema import parse
from asca_pillars.base.settings import read_settings, shipped_configs
from asca_pillars.sim.simulation import SimulationConfig

KIND = "simulation"


def load_simulation_config(path: str | None, view: str | None = None) -> SimulationConfig:
    """Read a YAML file with `scene`, `lidar` and `field_of_view`, of each what differs from the defaults.

    Args:
        path: the file, or the name of one in configs/simulation/; None for the defaults, which imitate KITTI.
        view: "full", "camera" or "around", which wins over the file.

    Raises:
        ConfigError: unreadable YAML, an unknown key anywhere (the nearest is named), an impossible value.
    """
    config = SimulationConfig() if path is None else read_settings(SimulationConfig, path, (), shipped_configs(KIND))
    if view is None:
        return config
    return replace(config, field_of_view=parse(SimulationConfig, {"field_of_view": view}, "--view").field_of_view)
