"""Body styles of cars and vans: their side views, their choice by size, and paint."""

from dataclasses import dataclass, replace

import numpy as np

from asca_pillars.sim.bodies.primitives import Surface


@dataclass(frozen=True)
class Profile:
    """Side view of a body style, as fractions of length (from the nose) and of height.

    Attributes:
        top: (x, z) of the outline from nose to tail.
        glass: spans of x between which the top outline is glass (windscreen, rear window).
        cabin: span of x that has side windows.
        belt: height of the belt line.
        tumble: half width of the roof over half width of the body.
    """

    top: tuple[tuple[float, float], ...]
    glass: tuple[tuple[float, float], ...]
    cabin: tuple[float, float]
    belt: float = 0.63
    tumble: float = 0.76


def outline(x: tuple[float, ...], z: tuple[float, ...]) -> tuple[tuple[float, float], ...]:
    """Return points from nose to tail: fractions of length, fractions of height."""
    return tuple(zip(x, z, strict=True))


# Roofs rise from the windscreen to about the driver's back and fall again: that slope is hit by rings of a sensor
# hardly higher than the roof.
CITY = Profile(
    outline(
        (0.0, 0.02, 0.06, 0.12, 0.23, 0.35, 0.45, 0.51, 0.58, 0.78, 0.9, 0.972, 0.99, 1.0),
        (0.32, 0.46, 0.55, 0.6, 0.67, 0.81, 0.92, 0.97, 1.0, 0.985, 0.935, 0.66, 0.6, 0.34),
    ),
    glass=((0.23, 0.45), (0.9, 0.972)),
    cabin=(0.28, 0.84),
    belt=0.64,
    tumble=0.78,
)
HATCHBACK = Profile(
    outline(
        (0.0, 0.02, 0.07, 0.15, 0.31, 0.39, 0.48, 0.54, 0.61, 0.7, 0.84, 0.9, 0.965, 0.99, 1.0),
        (0.34, 0.47, 0.55, 0.6, 0.66, 0.79, 0.91, 0.965, 0.995, 1.0, 0.965, 0.925, 0.69, 0.62, 0.36),
    ),
    glass=((0.31, 0.48), (0.9, 0.965)),
    cabin=(0.35, 0.83),
)
SALOON = Profile(
    outline(
        (0.0, 0.02, 0.06, 0.15, 0.29, 0.365, 0.45, 0.51, 0.57, 0.62, 0.72, 0.84, 0.93, 0.975, 0.985, 1.0),
        (0.34, 0.47, 0.55, 0.61, 0.67, 0.79, 0.9, 0.965, 0.995, 1.0, 0.955, 0.75, 0.73, 0.69, 0.56, 0.36),
    ),
    glass=((0.29, 0.45), (0.72, 0.84)),
    cabin=(0.33, 0.75),
)
ESTATE = Profile(
    outline(
        (0.0, 0.02, 0.06, 0.15, 0.28, 0.36, 0.45, 0.51, 0.58, 0.66, 0.86, 0.92, 0.97, 0.985, 1.0),
        (0.34, 0.47, 0.55, 0.61, 0.67, 0.79, 0.91, 0.965, 0.995, 1.0, 0.97, 0.93, 0.66, 0.6, 0.36),
    ),
    glass=((0.28, 0.45), (0.92, 0.97)),
    cabin=(0.32, 0.89),
)
SUV = Profile(
    outline(
        (0.0, 0.02, 0.05, 0.14, 0.29, 0.365, 0.45, 0.51, 0.59, 0.84, 0.9, 0.965, 0.99, 1.0),
        (0.4, 0.52, 0.6, 0.645, 0.69, 0.82, 0.93, 0.975, 1.0, 0.98, 0.945, 0.69, 0.62, 0.4),
    ),
    glass=((0.29, 0.45), (0.9, 0.965)),
    cabin=(0.33, 0.85),
    belt=0.66,
    tumble=0.8,
)
MINIVAN = Profile(
    outline(
        (0.0, 0.02, 0.05, 0.15, 0.22, 0.32, 0.42, 0.49, 0.57, 0.85, 0.93, 0.975, 0.99, 1.0),
        (0.3, 0.42, 0.5, 0.57, 0.62, 0.8, 0.92, 0.975, 1.0, 0.985, 0.95, 0.6, 0.5, 0.3),
    ),
    glass=((0.22, 0.42), (0.93, 0.975)),
    cabin=(0.26, 0.89),
    belt=0.59,
    tumble=0.84,
)
PICKUP = Profile(
    outline(
        (0.0, 0.02, 0.05, 0.24, 0.35, 0.42, 0.56, 0.6, 0.98, 0.99, 1.0),
        (0.36, 0.54, 0.6, 0.65, 0.96, 1.0, 0.98, 0.62, 0.6, 0.56, 0.36),
    ),
    glass=((0.24, 0.35), (0.56, 0.6)),
    cabin=(0.28, 0.58),
    belt=0.62,
    tumble=0.82,
)
CONVERTIBLE = Profile(
    outline(
        (0.0, 0.02, 0.06, 0.15, 0.32, 0.38, 0.43, 0.45, 0.46, 0.8, 0.95, 0.985, 1.0),
        (0.38, 0.52, 0.61, 0.67, 0.74, 0.88, 0.98, 1.0, 0.77, 0.77, 0.74, 0.62, 0.4),
    ),
    glass=((0.32, 0.43),),
    cabin=(0.33, 0.34),
    belt=0.7,
    tumble=0.8,
)
VAN = Profile(
    outline(
        (0.0, 0.015, 0.04, 0.16, 0.23, 0.29, 0.35, 0.45, 0.97, 0.99, 0.995, 1.0),
        (0.24, 0.36, 0.44, 0.52, 0.74, 0.92, 0.985, 1.0, 0.99, 0.8, 0.4, 0.24),
    ),
    glass=((0.16, 0.29),),
    cabin=(0.18, 0.36),
    belt=0.52,
    tumble=0.9,
)
# A small delivery van: a car's nose, a tall closed back.
BOX_VAN = Profile(
    outline(
        (0.0, 0.02, 0.06, 0.22, 0.31, 0.38, 0.43, 0.55, 0.96, 0.985, 0.99, 1.0),
        (0.28, 0.42, 0.48, 0.56, 0.76, 0.9, 0.97, 1.0, 0.985, 0.8, 0.4, 0.28),
    ),
    glass=((0.22, 0.38),),
    cabin=(0.26, 0.5),
    belt=0.56,
    tumble=0.88,
)


METALLIC_SHARE = 0.25  # of the cars that are not dark
PALE_SHARE = 0.2  # of the cars that are neither: matte pigment
BELT_LOWER = 0.035  # windows of today's streets begin lower than the profiles' outlines, fraction of height
# From behind, short cars look like long ones: their bonnets are shorter, not their cabins.
BONNET_PER_M, USUAL_LENGTH_M = 0.055, 3.75

Shares = tuple[tuple[Profile, float], ...]
_SMALL: Shares = ((CITY, 0.62), (HATCHBACK, 0.36), (CONVERTIBLE, 0.02))
_MIDDLE: Shares = ((HATCHBACK, 0.66), (SALOON, 0.12), (ESTATE, 0.10), (SUV, 0.09), (CONVERTIBLE, 0.03))
_LARGE: Shares = ((SALOON, 0.40), (ESTATE, 0.40), (HATCHBACK, 0.12), (SUV, 0.06), (CONVERTIBLE, 0.02))
_TALL: Shares = ((SUV, 0.42), (MINIVAN, 0.40), (CITY, 0.16), (PICKUP, 0.02))
_LOW_VAN: Shares = ((MINIVAN, 0.62), (BOX_VAN, 0.38))
_HIGH_VAN: Shares = ((VAN, 0.78), (BOX_VAN, 0.22))


def draw_style(rng: np.random.Generator, length_m: float, height_m: float, van: bool = False) -> Profile:
    """Return a body style that suits a size, with slightly varied cabin position and belt height."""
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
    """Return a profile with its windscreen moved by `bonnet`, a fraction of the length, and at random."""
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
    """Paint of upright panels, and of hood and roof, which rays graze: their scatter is weak but not zero."""

    upright: Surface
    flat: Surface

    @property
    def frame(self) -> Surface:
        """Pillars and frames of windows: black, or curved away from the sensor."""
        return Surface(max(0.1 * self.upright.reflectance, 0.025), 0.4)


def draw_paint(rng: np.random.Generator, dark_share: float = 0.5) -> Paint:
    """Return paint: dark, metallic or pale.

    Dark paint reflects at normal incidence and hardly anywhere else. Metallic paint is bright at short range, and
    farther away too weak for the sensor to report. Pale paint with a matte pigment reflects well from any side, others
    hardly at grazing incidence.
    """
    if rng.random() < dark_share:
        upright = _draw_surface(rng, (0.015, 0.04), (0.4, 1.6))
    elif rng.random() < METALLIC_SHARE:
        upright = _draw_surface(rng, (0.03, 0.2), (0.3, 1.2))
    elif rng.random() < PALE_SHARE:
        return Paint(Surface(float(rng.uniform(0.35, 0.65)), 0.1), Surface(float(rng.uniform(0.2, 0.45)), 0.2))
    else:
        upright = _draw_surface(rng, (0.22, 0.55), (0.1, 0.6))
    return Paint(upright, Surface(max(0.1 * upright.reflectance, 0.012), float(rng.uniform(0.25, 0.6))))


def _draw_surface(rng: np.random.Generator, reflectance: tuple[float, float], gloss: tuple[float, float]) -> Surface:
    """Return a surface within these bounds; the logarithm of its reflectance is uniformly distributed."""
    return Surface(float(np.exp(rng.uniform(*np.log(reflectance)))), float(rng.uniform(*gloss)))
