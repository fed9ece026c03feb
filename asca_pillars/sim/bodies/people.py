"""Pedestrians and sitting people, and objects that they carry, push and pull.

They consist of ellipsoids with jointed limbs; x forward, feet on z = 0.
"""

import numpy as np

from asca_pillars.geometry.arrays import Floats
from asca_pillars.sim.bodies.cycles import bicycle
from asca_pillars.sim.bodies.primitives import (
    Limb,
    Primitives,
    Surface,
    cuboids,
    draw_cloth,
    draw_skin,
    ellipsoids,
    jointed,
    prisms,
    quads,
)

# Fractions of people with each, in order; the others carry nothing.
SHARES = {
    "rucksack": 0.26,
    "bag": 0.18,
    "hip_bag": 0.08,
    "suitcase": 0.03,
    "pram": 0.04,
    "bicycle": 0.04,
    "umbrella": 0.03,
}
_WALKER_M = 1.5  # smaller people, children, push nothing


def draw_burden(rng: np.random.Generator, height: float, lean_m: float, shoulder_m: float) -> Primitives:
    """Return an object that a person of that height carries, pulls or pushes; often nothing."""
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
    """Return a pram: tub, hood and wheels."""
    tub = ellipsoids(
        [(0.75, 0, 0.72), (0.58, 0, 0.88)], [(0.38, 0.22, 0.17), (0.16, 0.22, 0.17)], np.repeat(cloth, 2, axis=0)
    )
    wheels = [(x, y, 0.0, 0.2, 0.04, 0.22, 0.0, 0.1, 0.3, 0.4) for x in (0.5, 1.0) for y in (0.24, -0.24)]
    return Primitives.join([tub, cuboids(wheels)])


def _umbrella(rng: np.random.Generator, height: float, lean_m: float, side: float, cloth: np.ndarray) -> Primitives:
    """Return an open umbrella over the head, a flat cap on a stick. It exceeds the label's box, as in KITTI."""
    top, radius = height + float(rng.uniform(0.0, 0.1)), float(rng.uniform(0.35, 0.45))
    place = (lean_m + 0.05, side * 0.05, top - 0.1)
    stick = prisms([(place[0], place[1], 0.6 * height, top - 0.6 * height, 0.02, 0.02, 0.2)], sides=4)
    return Primitives.join([ellipsoids([place], [(radius, radius, 0.1)], cloth), stick])


def pedestrian_body(
    rng: np.random.Generator, height: float, width: float, length: float, walked_m: float = 0.0
) -> Primitives:
    """Return a standing or walking person. `width` bounds the shoulders and arms, `length` the step and the swing.

    Only the step depends on `walked_m`: the same `rng` gives the same person.
    """
    h = height
    shoulder = float(np.clip(0.40 * width + 0.04, 0.19, 0.30)) * min(h / 1.6, 1.0)
    lean = float(rng.normal(0.03, 0.025)) * h  # forward, as when walking
    upper, lower, shoe = draw_cloth(rng, 3)
    skin = draw_skin(rng)
    thick = float(rng.uniform(1.35, 1.8))
    # A label box covers all the poses of a walk: in a single scan the feet are between together and far apart.
    stride = float(np.clip(length / 2 - 0.07, 0.06, 0.58)) * (1.0 if rng.random() < 0.88 else 0.2)
    # Feet rest on the ground where the step is widest: half of the walkers are near that phase.
    phase = float(rng.uniform(0.0, 2 * np.pi) if rng.random() < 0.5 else rng.normal(np.pi / 2, 0.5))
    phase += np.pi * walked_m / (2 * stride)  # a foot on the ground stays there while the body passes over it
    rows: list[Limb] = [
        ((0, 0, 0.52 * h), (lean, 0, 0.80 * h), shoulder * 0.9, 0.128 * thick, upper),
        ((lean * 0.8, 0, 0.70 * h), (lean, 0, 0.84 * h), shoulder, 0.115 * thick, upper),
        ((-0.03, 0, 0.46 * h), (-0.03, 0, 0.56 * h), 0.16 * thick, 0.125 * thick, lower),
        ((lean, 0, 0.82 * h), (lean + 0.03, 0, 0.86 * h), 0.055, 0.06, skin),
    ]
    for side in (1.0, -1.0):
        rows += _leg(h, side, stride, phase, thick, (lower, shoe))
        rows += _arm(rng, h, side, -0.75 * stride * np.sin(phase) * side, (lean, shoulder), (upper, skin))
    size = 0.066 if h > 1.4 else 0.076  # children have larger heads
    head = [(lean + 0.055, 0, (1.0 - size) * h), (lean + 0.025, 0, (1.0 - 0.92 * size) * h)]
    hair = draw_cloth(rng, 1)[0] * (0.6, 1.0, 1.0)
    parts = [
        jointed(rows),
        ellipsoids(head, [(0.108, 0.088, size * h), (0.112, 0.098, 0.9 * size * h)], np.stack([skin, hair])),
    ]
    dress = rng.random()
    if dress < 0.2:  # a skirt
        skirt = (0.14 + 0.3 * stride, 0.19, rng.uniform(0.16, 0.26) * h)
        parts.append(ellipsoids([(0, 0, 0.45 * h)], [skirt], lower[None]))
    elif dress < 0.55:  # a coat or a wide jacket
        coat = (0.15 * thick + 0.1 * stride, 0.95 * shoulder + 0.03, rng.uniform(0.24, 0.32) * h)
        parts.append(ellipsoids([(0.3 * lean, 0, 0.58 * h)], [coat], upper[None]))
    parts.append(draw_burden(rng, h, lean, shoulder))
    return Primitives.join(parts)


def _leg(h: float, side: float, stride: float, phase: float, thick: float, cloth: tuple[Floats, Floats]) -> list[Limb]:
    """Return thigh, shin and shoe of a walker; the leg that swings forward is bent and off the ground."""
    lower, shoe = cloth
    forward = stride * np.sin(phase) * side
    lift = 0.5 * min(stride, 0.3) * max(np.cos(phase) * side, 0.0)
    foot = (forward - 0.3 * lift, side * 0.09, 0.05 + lift)
    knee = (0.52 * forward + 0.03 + 0.06 * (forward > 0) + 0.6 * lift, side * 0.10, 0.28 * h + 0.35 * lift)
    heel = 0.25 * max(-forward - 0.06, 0.0)  # the foot behind stands on its toes, the one ahead on its sole
    return [
        ((0, side * 0.09, 0.52 * h), knee, 0.078 * thick, 0.088 * thick, lower),
        (knee, foot, 0.056 * thick, 0.062 * thick, lower),
        (
            (foot[0] - 0.06, foot[1], foot[2] - 0.01 + heel),
            (foot[0] + 0.18, side * 0.11, foot[2] - 0.015),
            0.055,
            0.055,
            shoe,
        ),
    ]


def _arm(
    rng: np.random.Generator,
    h: float,
    side: float,
    swing: float,
    trunk: tuple[float, float],
    cloth: tuple[Floats, Floats],
) -> list[Limb]:
    """Return upper arm and forearm: swinging, or bent to hold, point or telephone. `trunk`: lean, shoulder."""
    lean, shoulder = trunk
    upper, skin = cloth
    swing += float(rng.normal(0.0, 0.04))
    habit = rng.random()
    bent = rng.uniform(0.04, 0.24) if habit < 0.7 else rng.uniform(0.2, 0.35)
    elbow = (lean + 0.45 * swing - 0.02, side * (shoulder + 0.05), 0.63 * h)
    inward = 0.4 * bent * (bent > 0.2)
    hand = (elbow[0] + 0.4 * swing + bent, side * (shoulder + 0.03 - inward), 0.50 * h + 0.5 * bent)
    if habit > 0.95:  # at the ear
        hand = (lean + 0.08, side * 0.12, 0.88 * h)
    return [
        ((lean, side * (shoulder + 0.02), 0.81 * h), elbow, 0.07, 0.075, upper),
        (elbow, hand, 0.053, 0.056, upper if rng.random() < 0.7 else skin),
    ]


def sitting_body(rng: np.random.Generator, height: float) -> Primitives:
    """Return a person on a chair or a bench; `height` is that of the head above the ground."""
    h = height
    upper, lower = draw_cloth(rng, 2)
    seat = 0.36 * h
    rows: list[Limb] = [((-0.1, 0, seat), (-0.14, 0, 0.78 * h), 0.19, 0.12, upper)]
    for side in (0.11, -0.11):
        rows += [
            ((-0.1, side, seat + 0.03), (0.32, side * 1.3, seat + 0.05), 0.08, 0.08, lower),
            ((0.32, side * 1.3, seat + 0.04), (0.34, side * 1.2, 0.06), 0.06, 0.06, lower),
            ((0.28, side * 1.2, 0.05), (0.48, side * 1.3, 0.04), 0.045, 0.04, lower),
            ((-0.12, side * 1.9, 0.76 * h), (0.02, side * 2.1, 0.55 * h), 0.05, 0.05, upper),
            ((0.02, side * 2.1, 0.55 * h), (0.25, side * 1.2, 0.52 * h), 0.04, 0.04, upper),
        ]
    head = ellipsoids([(-0.1, 0, 0.91 * h)], [(0.10, 0.08, 0.09 * h)], np.array([[0.4, 0.2, 0.0]]))
    chair = Surface(0.2, 0.3)
    boards = quads(
        [
            [
                (-0.3, 0.24, seat - 0.05),
                (0.2, 0.24, seat - 0.05),
                (0.2, -0.24, seat - 0.05),
                (-0.3, -0.24, seat - 0.05),
            ],
            [(-0.3, 0.24, seat), (-0.34, 0.24, 0.65 * h), (-0.34, -0.24, 0.65 * h), (-0.3, -0.24, seat)],
        ],
        chair,
    )
    return Primitives.join([jointed(rows), head, boards])
