"""Body styles of cars and vans as side views, which of them a size suggests, and their paint."""

from dataclasses import dataclass, replace

import numpy as np

from asca_pillars.sim.bodies.primitives import Surface


@dataclass(frozen=True)
class Profile:
    """Side view of a body style, as shares of length (from the nose) and of height.

    Attributes:
        top: (x, z) of the outline from nose to tail.
        glass: spans of x between which the top outline is a pane (windscreen, rear window).
        cabin: span of x that has side windows.
        belt: height of the belt line.
        tumble: half width of the roof over half width of the body.
    """

    top: tuple[tuple[float, float], ...]
    glass: tuple[tuple[float, float], ...]
    cabin: tuple[float, float]
    belt: float = 0.63
    tumble: float = 0.76


# Roofs rise from the windscreen to about the driver's back and fall again: that slope is what rings of a sensor
# hardly higher than the roof meet.
CITY = Profile(
    ((0.0, 0.32), (0.02, 0.46), (0.06, 0.55), (0.12, 0.60), (0.23, 0.67), (0.34, 0.82), (0.43, 0.92), (0.51, 0.97),
     (0.62, 1.0), (0.80, 0.985), (0.90, 0.94), (0.965, 0.64), (0.985, 0.58), (1.0, 0.34)),
    ((0.23, 0.43), (0.90, 0.965)), (0.28, 0.91), 0.64, 0.78,
)  # fmt: skip
HATCHBACK = Profile(
    ((0.0, 0.34), (0.02, 0.47), (0.07, 0.55), (0.15, 0.60), (0.31, 0.66), (0.39, 0.79), (0.47, 0.90), (0.54, 0.955),
     (0.63, 0.99), (0.72, 1.0), (0.84, 0.975), (0.90, 0.93), (0.955, 0.68), (0.985, 0.62), (1.0, 0.36)),
    ((0.31, 0.47), (0.90, 0.955)), (0.35, 0.90),
)  # fmt: skip
SALOON = Profile(
    ((0.0, 0.34), (0.02, 0.47), (0.06, 0.55), (0.15, 0.61), (0.29, 0.67), (0.36, 0.79), (0.43, 0.90), (0.50, 0.96),
     (0.58, 0.995), (0.64, 1.0), (0.72, 0.965), (0.84, 0.75), (0.93, 0.73), (0.975, 0.69), (0.985, 0.56), (1.0, 0.36)),
    ((0.29, 0.43), (0.72, 0.84)), (0.33, 0.80),
)  # fmt: skip
ESTATE = Profile(
    ((0.0, 0.34), (0.02, 0.47), (0.06, 0.55), (0.15, 0.61), (0.28, 0.67), (0.355, 0.79), (0.42, 0.90), (0.49, 0.96),
     (0.58, 0.995), (0.68, 1.0), (0.86, 0.975), (0.92, 0.93), (0.97, 0.66), (0.985, 0.60), (1.0, 0.36)),
    ((0.28, 0.42), (0.92, 0.97)), (0.32, 0.94),
)  # fmt: skip
SUV = Profile(
    ((0.0, 0.40), (0.02, 0.52), (0.05, 0.60), (0.14, 0.645), (0.29, 0.69), (0.36, 0.82), (0.43, 0.93), (0.50, 0.975),
     (0.60, 1.0), (0.84, 0.985), (0.90, 0.95), (0.955, 0.68), (0.985, 0.60), (1.0, 0.40)),
    ((0.29, 0.43), (0.90, 0.955)), (0.33, 0.92), 0.66, 0.80,
)  # fmt: skip
MINIVAN = Profile(
    ((0.0, 0.30), (0.02, 0.42), (0.05, 0.50), (0.15, 0.57), (0.22, 0.62), (0.32, 0.80), (0.40, 0.92), (0.48, 0.975),
     (0.58, 1.0), (0.85, 0.985), (0.93, 0.95), (0.975, 0.60), (0.99, 0.50), (1.0, 0.30)),
    ((0.22, 0.40), (0.93, 0.975)), (0.26, 0.94), 0.59, 0.84,
)  # fmt: skip
PICKUP = Profile(
    ((0.0, 0.36), (0.02, 0.54), (0.05, 0.60), (0.24, 0.65), (0.35, 0.96), (0.42, 1.0), (0.56, 0.98), (0.60, 0.62),
     (0.98, 0.60), (0.99, 0.56), (1.0, 0.36)),
    ((0.24, 0.35), (0.56, 0.60)), (0.28, 0.58), 0.62, 0.82,
)  # fmt: skip
CONVERTIBLE = Profile(
    ((0.0, 0.38), (0.02, 0.52), (0.06, 0.61), (0.15, 0.67), (0.32, 0.74), (0.38, 0.88), (0.43, 0.98), (0.45, 1.0),
     (0.46, 0.77), (0.80, 0.77), (0.95, 0.74), (0.985, 0.62), (1.0, 0.40)),
    ((0.32, 0.43),), (0.33, 0.34), 0.70, 0.80,
)  # fmt: skip
VAN = Profile(
    ((0.0, 0.24), (0.015, 0.36), (0.04, 0.44), (0.16, 0.52), (0.23, 0.74), (0.29, 0.92), (0.35, 0.985), (0.45, 1.0),
     (0.97, 0.99), (0.99, 0.80), (0.995, 0.40), (1.0, 0.24)),
    ((0.16, 0.29),), (0.18, 0.36), 0.52, 0.90,
)  # fmt: skip
BOX_VAN = Profile(  # a small delivery van: a car's nose, a tall closed back
    ((0.0, 0.28), (0.02, 0.42), (0.06, 0.48), (0.22, 0.56), (0.31, 0.76), (0.38, 0.90), (0.43, 0.97), (0.55, 1.0),
     (0.96, 0.985), (0.985, 0.80), (0.99, 0.40), (1.0, 0.28)),
    ((0.22, 0.38),), (0.26, 0.50), 0.56, 0.88,
)  # fmt: skip

PALE_SHARE = 0.25  # of the cars that are not dark
BELT_LOWER = 0.035  # windows of today's streets begin lower than the profiles' outlines suggest, share of height

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
    return _varied(shares[int(rng.choice(len(shares), p=weights / weights.sum()))][0], rng)


def _varied(profile: Profile, rng: np.random.Generator) -> Profile:
    base, tail = profile.glass[0][0], profile.cabin[1]
    if tail - base < 0.1:
        tail = 0.8
    x_from = (0.0, base, tail, 1.0)
    x_to = (0.0, base + rng.normal(0.0, 0.02), tail + min(rng.normal(0.0, 0.015), 0.8 * (1.0 - tail)), 1.0)
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
    """Paint: dark lacquers shine where they are met head on and send hardly anything back elsewhere; pale ones with
    a matte pigment send back a good deal from any side, others scatter hardly anything where rays only graze them."""
    if rng.random() < dark_share:
        value, gloss = float(np.exp(rng.uniform(np.log(0.012), np.log(0.035)))), float(rng.uniform(0.5, 1.8))
    else:
        value, gloss = float(np.exp(rng.uniform(np.log(0.22), np.log(0.75)))), float(rng.uniform(0.1, 0.6))
        if rng.random() < PALE_SHARE:
            return Paint(Surface(float(rng.uniform(0.5, 0.95)), 0.1), Surface(float(rng.uniform(0.3, 0.6)), 0.2))
    return Paint(Surface(value, gloss), Surface(max(0.1 * value, 0.012), float(rng.uniform(0.25, 0.6))))
