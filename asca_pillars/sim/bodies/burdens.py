"""What people on foot carry, push and pull; x ahead, feet on z = 0."""

import numpy as np

from asca_pillars.sim.bodies.bicycles import bicycle
from asca_pillars.sim.bodies.figures import draw_cloth
from asca_pillars.sim.bodies.primitives import Primitives, cuboids, ellipsoids, prisms

# Shares of people with each, one after another; the others carry nothing.
SHARES = {
    "rucksack": 0.26,
    "bag": 0.18,
    "hip_bag": 0.08,
    "suitcase": 0.03,
    "pram": 0.04,
    "bicycle": 0.04,
    "umbrella": 0.03,
}
_WALKER_M = 1.5  # children push nothing


def draw_burden(rng: np.random.Generator, height: float, lean_m: float, shoulder_m: float) -> Primitives:
    """What a person of that height carries, pulls or pushes; often nothing."""
    names = (*SHARES, "nothing")
    what = names[int(np.searchsorted(np.cumsum(list(SHARES.values())), rng.random()))]
    side = float(rng.choice([-1.0, 1.0]))
    cloth = draw_cloth(rng, 1)
    if what == "rucksack":
        size = (rng.uniform(0.10, 0.16), rng.uniform(0.14, 0.19), rng.uniform(0.12, 0.17) * height)
        return ellipsoids([(lean_m - 0.21, 0, 0.70 * height)], [size], cloth)
    if what == "bag":
        place = (rng.normal(0, 0.05), side * (shoulder_m + 0.06), 0.36 * height)
        return ellipsoids([place], [(0.18, 0.08, 0.15)], cloth)
    if what == "hip_bag":
        return ellipsoids([(-0.02, side * 0.2, 0.53 * height)], [(0.17, 0.08, 0.13)], cloth)
    if what == "suitcase":
        return cuboids([(-0.5, side * 0.2, 0.05, 0.25, 0.4, 0.6, 0.0, *cloth[0, :2], 0.0)])
    if what == "umbrella":
        return _umbrella(rng, height, lean_m, side, cloth)
    if what == "pram" and height > _WALKER_M:
        return _pram(cloth)
    if what == "bicycle" and height > _WALKER_M:
        return bicycle(rng, float(rng.uniform(1.5, 1.8))).placed(float(rng.uniform(0.0, 0.3)), side * 0.42, 0.0, 0.0)
    return Primitives.join([])


def _pram(cloth: np.ndarray) -> Primitives:
    """A tub, a hood and wheels."""
    tub = ellipsoids(
        [(0.75, 0, 0.72), (0.58, 0, 0.88)], [(0.38, 0.22, 0.17), (0.16, 0.22, 0.17)], np.repeat(cloth, 2, axis=0)
    )
    wheels = [(x, y, 0.0, 0.2, 0.04, 0.22, 0.0, 0.1, 0.3, 0.4) for x in (0.5, 1.0) for y in (0.24, -0.24)]
    return Primitives.join([tub, cuboids(wheels)])


def _umbrella(rng: np.random.Generator, height: float, lean_m: float, side: float, cloth: np.ndarray) -> Primitives:
    """Open, over the head: a flat cap on a stick. It stands out of the label's box, as KITTI's do."""
    top, radius = height + float(rng.uniform(0.0, 0.1)), float(rng.uniform(0.35, 0.45))
    place = (lean_m + 0.05, side * 0.05, top - 0.1)
    stick = prisms([(place[0], place[1], 0.6 * height, top - 0.6 * height, 0.02, 0.02, 0.2)], sides=4)
    return Primitives.join([ellipsoids([place], [(radius, radius, 0.1)], cloth), stick])
