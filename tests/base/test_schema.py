"""Plain data to typed settings: every mistake at every depth becomes one line that names the key."""

from dataclasses import dataclass, field
from typing import Annotated, Any

import pytest
from pydantic import Discriminator, Tag

from asca_pillars.base.errors import ConfigError
from asca_pillars.base.schema import parse, to_dict
from asca_pillars.base.strict import Strict


@dataclass(frozen=True)
class Wheel(Strict):
    radius_m: float
    spokes: int = 32


@dataclass(frozen=True)
class Engine(Strict):
    power_kw: float = 80.0

    def __post_init__(self) -> None:
        if self.power_kw <= 0:
            raise ConfigError(f"power_kw {self.power_kw:g} must be positive")


@dataclass(frozen=True)
class Vehicle(Strict):
    name: str
    engine: Engine = field(default_factory=Engine)
    spare: Engine | None = None
    wheels: tuple[Wheel, ...] = ()
    span_m: tuple[float, float] = (0.0, 4.5)
    notes: dict[str, str] = field(default_factory=dict)


def refusal(data: dict[str, Any]) -> str:
    with pytest.raises(ConfigError) as caught:
        parse(Vehicle, data, "car.yaml")
    assert "\n" not in str(caught.value)
    assert caught.value.__suppress_context__ and caught.value.__cause__ is None, "pydantic would speak too"
    return str(caught.value)


WHEEL = {"radius_m": 0.3}


@pytest.mark.parametrize(
    ("data", "message"),
    [
        ({"nam": "van"}, "unknown key `nam`; did you mean `name`?"),
        ({"engine": {"powr_kw": 3}}, "unknown key `engine.powr_kw`; did you mean `power_kw`?"),
        ({"wheels": [WHEEL, WHEEL | {"spoke": 8}]}, "unknown key `wheels.1.spoke`; did you mean `spokes`?"),
        ({"engine": {"zzz": 3}}, "unknown key `engine.zzz`; known keys: power_kw"),
        ({"engine": {"[key]": 1}}, "unknown key `engine.[key]`; known keys: power_kw"),
        ({"spare": {"power": 3}}, "unknown key `spare.power`; did you mean `power_kw`?"),
        ({"wheels[0]": 1}, "unknown key `wheels[0]`; did you mean `wheels`?"),
        ({"wheels": [{"spokes": 3}]}, "missing key `wheels.0.radius_m`"),
        ({"span_m": [1.0]}, "missing key `span_m.1`"),
        ({"engine": {"power_kw": "strong"}}, "`engine.power_kw` = 'strong': input should be a valid number"),
        ({"engine": 3}, "`engine` = 3: input should be a dictionary"),
        ({"wheels": [WHEEL | {"spokes": 2.5}]}, "`wheels.0.spokes` = 2.5: input should be a valid int"),
        ({"name": None}, "`name` = None: input should be a valid string"),
        ({"notes": {1: "x"}}, "`notes.1` = 1: input should be a valid string"),
        ({3: 4}, "`3` = 3: keys should be strings"),
        ({"engine": {"power_kw": 0}}, "power_kw 0 must be positive"),
        ({"engine": {"power_kw": True}}, "`engine.power_kw` = true: input should be a number"),
        ({"wheels": [WHEEL, WHEEL | {"spokes": False}]}, "`wheels.1.spokes` = false: input should be a number"),
    ],
)
def test_a_mistake_is_one_line_that_names_the_key(data: dict[str, Any], message: str) -> None:
    assert refusal({"name": "van"} | data).startswith(f"car.yaml: {message}")
    assert refusal({}).startswith("car.yaml: missing key `name`")
    assert "`nme`" in refusal({"nme": "van", "engine": {"power_kw": "strong"}}), "before what it leaves missing"


def test_nested_data_becomes_dataclasses_and_back() -> None:
    vehicle = Vehicle("van", Engine(60.0), Engine(1.0), (Wheel(0.3), Wheel(0.4, 8)), (1.0, 2.0), {"a": "b"})
    plain = to_dict(vehicle)
    assert plain == {
        "name": "van",
        "engine": {"power_kw": 60.0},
        "spare": {"power_kw": 1.0},
        "wheels": [{"radius_m": 0.3, "spokes": 32}, {"radius_m": 0.4, "spokes": 8}],
        "span_m": [1.0, 2.0],
        "notes": {"a": "b"},
    }
    assert parse(Vehicle, plain, "car.yaml") == vehicle
    whole = parse(Vehicle, {"name": "van", "engine": {"power_kw": 60}, "wheels": [{"radius_m": 1}]}, "car.yaml")
    assert whole == Vehicle("van", Engine(60.0), wheels=(Wheel(1.0),)) and isinstance(whole.engine.power_kw, float)


@dataclass(frozen=True)
class Round(Strict):
    kind: str = "round"
    radius_m: float = 1.0


@dataclass(frozen=True)
class Square(Strict):
    kind: str = "square"
    side_m: float = 1.0


@dataclass(frozen=True)
class Holder(Strict):
    shape: Annotated[
        Annotated[Round, Tag("round")] | Annotated[Square, Tag("square")],
        Discriminator(lambda value: value.get("kind", "round") if isinstance(value, dict) else value.kind),
    ] = field(default_factory=Round)


@pytest.mark.parametrize(
    ("shape", "message"),
    [
        ({"kind": "square", "side_m": "wide"}, "`shape.side_m` = 'wide': input should be a valid number"),
        ({"radus_m": 1}, "unknown key `shape.radus_m`; did you mean `radius_m`?"),
        ({"kind": "square", "sid_m": 1}, "unknown key `shape.sid_m`; did you mean `side_m`?"),
        ({"kind": "triangle"}, "`shape.kind` = 'triangle': input should be 'round', 'square'"),
    ],
)
def test_a_tagged_union_is_read_by_its_kind_and_blamed_without_its_tag(shape: dict[str, Any], message: str) -> None:
    assert parse(Holder, {"shape": {"radius_m": 2}}, "f").shape == Round(radius_m=2)
    assert parse(Holder, {"shape": {"kind": "square", "side_m": 2}}, "f").shape == Square(side_m=2)
    with pytest.raises(ConfigError) as caught:
        parse(Holder, {"shape": shape}, "f")
    assert str(caught.value).startswith(f"f: {message}")
