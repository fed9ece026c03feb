"""What to simulate, from a YAML file: the shipped ones, and mistakes that are told in one line."""

from pathlib import Path

import pytest

from asca_pillars.base.errors import ConfigError
from asca_pillars.base.settings import shipped_configs
from asca_pillars.sim.simulation import KIND, SimulationConfig, load_simulation_config, simulate_frame

SHIPPED = sorted((Path(__file__).parents[2] / "configs" / KIND).glob("*.yaml"))


@pytest.mark.parametrize("path", SHIPPED, ids=lambda path: path.stem)
def test_configs_that_ship_load_and_simulate(path: Path) -> None:
    config = load_simulation_config(str(path))
    assert load_simulation_config(path.stem) == config, "found by its name too"
    assert config != SimulationConfig(), "it says something"
    frame = simulate_frame(0, 0, load_simulation_config(path.stem, "camera"))
    assert len(frame.points) > 500


def test_files_hold_what_differs_and_kinds_are_not_mixed_up(tmp_path: Path) -> None:
    assert load_simulation_config(None) == SimulationConfig()
    path = tmp_path / "mine.yaml"
    path.write_text("field_of_view: camera\nscene: {cars: 1.5, sensor_height_m: [2.0, 2.1]}\n")
    config = load_simulation_config(str(path))
    assert (config.field_of_view, config.scene.cars, config.scene.sensor_height_m) == ("camera", 1.5, (2.0, 2.1))
    assert config.lidar == SimulationConfig().lidar and config.scene.vans == SimulationConfig().scene.vans
    assert load_simulation_config(str(path), "full").field_of_view == "full"
    with pytest.raises(ConfigError, match=r"these ship: .*residential"):
        load_simulation_config("resident")
    with pytest.raises(ConfigError, match="--view: `field_of_view` = 'rear'"):
        load_simulation_config(None, "rear")
    assert SHIPPED and set(shipped_configs(KIND)) == {path.stem for path in SHIPPED}
    assert not set(shipped_configs(KIND)) & set(shipped_configs())


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("scene: {carz: 1}", r"unknown key `scene\.carz`; did you mean `cars`\?"),
        ("scenes: {cars: 1}", r"unknown key `scenes`; did you mean `scene`\?"),
        ("scene: {cars: -1}", "cars is -1"),
        ("scene: {cars: many}", "`scene.cars` = 'many'"),
        ("lidar: {range: [2, 60]}", "unknown key `lidar.range`; did you mean `range_m`"),
        ("field_of_view: rear", "field_of_view"),
        ("- cars", "expected `key: value` lines"),
    ],
)
def test_mistakes_are_told_in_one_line(tmp_path: Path, text: str, told: str) -> None:
    path = tmp_path / "mine.yaml"
    path.write_text(text + "\n")
    with pytest.raises(ConfigError, match=told) as caught:
        load_simulation_config(str(path))
    assert str(caught.value).startswith(str(path)) and "\n" not in str(caught.value)
