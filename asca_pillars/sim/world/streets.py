"""Random streets: kind, width, slopes, and surroundings of the carriageway."""

from bisect import bisect_right
from dataclasses import replace
from itertools import accumulate
from typing import Any

import numpy as np

from asca_pillars.sim.casting.groundcast import NO_RAILS, TRACK_SPACING_HALF_M
from asca_pillars.sim.scene_config import SceneConfig
from asca_pillars.sim.world.ground import Ground, draw_relief, make_street

# narrow with parked cars, wide in town, out of town, square or campus, trunk road, alley between walls
KINDS = ("residential", "urban", "rural", "campus", "road", "alley")
HALF_WIDTH_M = {
    "residential": (2.7, 4.3),
    "urban": (3.6, 8.0),
    "rural": (3.2, 6.0),
    "campus": (2.5, 6.0),
    "road": (4.0, 8.0),
    "alley": (2.2, 3.2),
}
PAVEMENT_M = {
    "residential": (1.0, 3.0),
    "urban": (2.0, 5.0),
    "rural": (0.3, 2.0),
    "campus": (1.0, 10.0),
    "road": (0.2, 1.5),
    "alley": (0.0, 1.0),
}
DIVIDED_SHARE = {"road": 0.6, "urban": 0.2, "rural": 0.1}
RAILS_FACTOR = {"urban": 2.0, "road": 2.0, "alley": 0.0, "residential": 0.5}
STEEP_SHARE = {"rural": 0.35, "road": 0.3}


def draw_kind(config: SceneConfig, rng: np.random.Generator) -> str:
    """Draw the kind of a street."""
    shares = np.array([getattr(config, kind) for kind in KINDS])
    return KINDS[int(rng.choice(len(KINDS), p=shares / shares.sum()))]


def draw_ground(config: SceneConfig, rng: np.random.Generator, kind: str) -> Ground:
    """Draw the ground of a street of that kind; the car is in a lane at the origin."""
    half = float(rng.uniform(*HALF_WIDTH_M[kind]))
    lanes = max(int(half // 3.1), 1)
    width = half / lanes
    # The car is in a right-hand lane; the road's middle is to its left.
    offset = (int(rng.integers(lanes)) + 0.5) * width + rng.normal(0.0, 0.25)
    junction = rng.random() < config.junction_share * (0.5 if kind == "road" else 1.0)
    kerb = 0.0 if rng.random() < 0.12 else float(rng.uniform(0.03, 0.17))
    median = half > 6.0 and rng.random() < config.median_share
    turning = kind != "alley" and rng.random() < config.turning_share
    steep = rng.random() < STEEP_SHARE.get(kind, 0.05)
    street = make_street(
        yaw_rad=rng.normal(0.0, config.heading_error_sigma_rad) + (rng.uniform(-0.5, 0.5) if turning else 0.0),
        bend_per_m=rng.normal(0.0, config.bend_sigma_per_m),
        offset_m=offset,
        half_width_m=half,
        cross_u_m=rng.uniform(-30.0, 55.0),
        cross_half_m=rng.uniform(2.5, 6.0) if junction else 0.0,
        cross_tilt_rad=rng.normal(0.0, 0.12),
        kerb_m=kerb,
        pavement_m=rng.uniform(*PAVEMENT_M[kind]),
        lane_m=width if kind in ("urban", "rural", "road") and rng.random() < 0.8 else 0.0,
        bank_left=_bank(config, rng, steep),
        bank_right=_bank(config, rng, steep),
        ditch_m=rng.uniform(*config.ditch_m) if steep and rng.random() < 0.6 else 0.0,
        median_half_m=rng.uniform(0.4, 1.5) if median else 0.0,
        rough_m=rng.uniform(*config.grass_m),
        camber=rng.uniform(0.0, 0.035),
        **_tracks_and_second_carriageway(config, rng, kind, half),
    )
    asphalt = float(np.clip(rng.normal(0.22, 0.03), 0.13, 0.33))
    of_asphalt = np.array([1.0, rng.uniform(0.85, 1.25), 0.0, rng.uniform(1.2, 1.9), 0.0, rng.uniform(0.6, 1.2)])
    reflectance = asphalt * of_asphalt + (0.0, 0.0, rng.uniform(0.22, 0.42), 0.0, 0.15, 0.0)
    slope = (rng.normal(*config.slope_x), rng.normal(*config.slope_y))
    low, high = config.relief_m
    # Most streets are flat and some are hilly: the square of a uniform random number.
    amplitude = low + (high - low) * rng.random() ** 2
    relief = draw_relief(rng, slope, amplitude, street, rng.uniform(*config.bump_m))
    ground = Ground(street, relief, reflectance, 0.0)
    under_car = float(ground.heights((0.0, 0.0))[0])
    return replace(ground, z_m=-float(rng.uniform(*config.sensor_height_m)) - under_car)


def _bank(config: SceneConfig, rng: np.random.Generator, steep: bool) -> float:
    """Draw the slope of the ground beyond the pavement: mostly slight, an embankment beside some roads out of town."""
    return float(rng.uniform(*config.embankment_slope) if steep else rng.normal(0.0, config.bank_slope_sigma))


def _tracks_and_second_carriageway(
    config: SceneConfig, rng: np.random.Generator, kind: str, half: float
) -> dict[str, float]:
    """Draw tracks in the road or on a bed of ballast left of it, and a second carriageway beyond."""
    numbers = {"rails_v_m": NO_RAILS}
    divided = rng.random() < DIVIDED_SHARE.get(kind, 0.0)
    strip = float(rng.uniform(0.8, 4.0))
    if rng.random() < min(config.rails_share * RAILS_FACTOR.get(kind, 1.0), 1.0):
        two = rng.random() < 0.6
        numbers["tracks"] = 2.0 if two else 1.0
        if divided or rng.random() < 0.3:
            bed_half = (TRACK_SPACING_HALF_M if two else 0.0) + rng.uniform(1.3, 1.8)
            strip = float(2 * bed_half + rng.uniform(0.2, 1.5))
            numbers |= {
                "rails_v_m": half + strip / 2,
                "bed_half_m": bed_half,
                "bed_m": rng.uniform(0.0, 0.25),
                "rail_m": rng.uniform(0.05, 0.18),
            }
        else:
            numbers |= {"rails_v_m": rng.uniform(-0.3, 0.9) * half, "rail_m": rng.uniform(0.01, 0.03)}
    if divided:
        second = float(rng.uniform(3.2, 6.0))
        numbers |= {"second_v_m": half + strip + second, "second_half_m": second}
    return numbers


class ScalarDraws(np.random.Generator):
    """NumPy's generator with the same numbers in the same order, twice as fast for single ones."""

    def uniform(self, low: Any = 0.0, high: Any = 1.0, size: Any = None) -> Any:
        """Draw as NumPy's `uniform`."""
        if size is None and isinstance(low, float) and isinstance(high, float) and low <= high:
            return low + (high - low) * self.random()
        return super().uniform(low, high, size)

    def choice(self, a: Any, size: Any = None, replace: bool = True, p: Any = None, axis: int = 0, **rest: Any) -> Any:  # type: ignore[override]
        """Draw as NumPy's `choice`, but return one of a list or a tuple as that item itself."""
        if size is not None or not isinstance(a, int | list | tuple):
            return super().choice(a, size, replace, p, axis, **rest)
        number = a if isinstance(a, int) else len(a)
        index = int(self.integers(number)) if p is None else self._index(p)
        return index if isinstance(a, int) else a[index]

    def _index(self, shares: Any) -> int:
        upto = list(accumulate(np.asarray(shares).tolist()))
        return bisect_right([share / upto[-1] for share in upto], self.random())


def draws_of(*seed: int) -> ScalarDraws:
    """Return the generator of a seed of several numbers, as `np.random.default_rng(seed)`."""
    return ScalarDraws(np.random.PCG64(seed))
