"""Which body style a size of car or van suggests, and its paint."""

from dataclasses import dataclass, replace

import numpy as np

from asca_pillars.sim.bodies.primitives import Surface
from asca_pillars.sim.bodies.profiles import (
    BOX_VAN,
    CITY,
    CONVERTIBLE,
    ESTATE,
    HATCHBACK,
    MINIVAN,
    PICKUP,
    SALOON,
    SUV,
    VAN,
    Profile,
)

PALE_SHARE = 0.2  # of the cars that are not dark
BELT_LOWER = 0.035  # windows of today's streets begin lower than the profiles' outlines suggest, share of height
# Seen from behind, short cars look like long ones: their bonnets are shorter, not their cabins.
BONNET_PER_M, USUAL_LENGTH_M = 0.055, 3.75

Shares = tuple[tuple[Profile, float], ...]
_SMALL: Shares = ((CITY, 0.62), (HATCHBACK, 0.36), (CONVERTIBLE, 0.02))
_MIDDLE: Shares = ((HATCHBACK, 0.66), (SALOON, 0.12), (ESTATE, 0.10), (SUV, 0.09), (CONVERTIBLE, 0.03))
_LARGE: Shares = ((SALOON, 0.40), (ESTATE, 0.40), (HATCHBACK, 0.12), (SUV, 0.06), (CONVERTIBLE, 0.02))
_TALL: Shares = ((SUV, 0.42), (MINIVAN, 0.40), (CITY, 0.16), (PICKUP, 0.02))
_LOW_VAN: Shares = ((MINIVAN, 0.62), (BOX_VAN, 0.38))
_HIGH_VAN: Shares = ((VAN, 0.78), (BOX_VAN, 0.22))


def draw_style(rng: np.random.Generator, length_m: float, height_m: float, van: bool = False) -> Profile:
    """A body style that suits a size, with its cabin a little moved and its belt a little raised or lowered."""
    if van:
        shares = _LOW_VAN if height_m < 2.05 else _HIGH_VAN
    elif height_m > 1.63:
        shares = _TALL
    else:
        shares = _SMALL if length_m < 3.65 else _MIDDLE if length_m < 4.2 else _LARGE
    weights = np.array([weight for _, weight in shares])
    bonnet = 0.0 if van else BONNET_PER_M * (length_m - USUAL_LENGTH_M)
    return _varied(shares[int(rng.choice(len(shares), p=weights / weights.sum()))][0], bonnet, rng)


def _varied(profile: Profile, bonnet: float, rng: np.random.Generator) -> Profile:
    """A profile with its windscreen moved by `bonnet`, a share of the length, and at random."""
    base, tail = profile.glass[0][0], profile.cabin[1]
    if tail - base < 0.1:
        tail = 0.8
    x_from = (0.0, base, tail, 1.0)
    x_to = (
        0.0,
        base + bonnet + float(np.clip(rng.normal(0.0, 0.035), -0.08, 0.08)),
        tail + min(rng.normal(0.0, 0.015), 0.8 * (1.0 - tail)),
        1.0,
    )
    lift = float(np.clip(rng.normal(-BELT_LOWER, 0.02), -0.08, 0.02))

    outline = np.array(profile.top)
    z = np.interp(outline[:, 1], (0.0, profile.belt, 1.0), (0.0, profile.belt + lift, 1.0))
    x = np.interp([*outline[:, 0], *profile.cabin, *np.ravel(profile.glass)], x_from, x_to).tolist()
    cabin, glass = x[len(z) : len(z) + 2], x[len(z) + 2 :]
    return replace(
        profile,
        top=tuple(zip(x[: len(z)], z.tolist(), strict=True)),
        glass=tuple(zip(glass[::2], glass[1::2], strict=True)),
        cabin=(cabin[0], cabin[1]),
        belt=profile.belt + lift,
        tumble=profile.tumble + float(rng.uniform(-0.03, 0.03)),
    )


@dataclass(frozen=True)
class Paint:
    """Lacquer on upright panels, and on hood and roof, which rays only graze: their scatter is weak but stays."""

    upright: Surface
    flat: Surface


def draw_paint(rng: np.random.Generator, dark_share: float = 0.5) -> Paint:
    """Paint, dark or pale.

    Dark lacquers shine where they are met head on and send hardly anything back elsewhere; pale ones with a matte
    pigment send back a good deal from any side, others scatter hardly anything where rays only graze them.
    """
    if rng.random() < dark_share:
        value, gloss = float(np.exp(rng.uniform(np.log(0.012), np.log(0.035)))), float(rng.uniform(0.5, 1.8))
    else:
        value, gloss = float(np.exp(rng.uniform(np.log(0.22), np.log(0.55)))), float(rng.uniform(0.1, 0.6))
        if rng.random() < PALE_SHARE:
            return Paint(Surface(float(rng.uniform(0.35, 0.65)), 0.1), Surface(float(rng.uniform(0.2, 0.45)), 0.2))
    return Paint(Surface(value, gloss), Surface(max(0.1 * value, 0.012), float(rng.uniform(0.25, 0.6))))
