"""Objects of the height of a person's hip or shoulder, and corners of low walls.

Detectors trained without them detect bollards, litter bins, low signs and stones in KITTI's drives as pedestrians
and cyclists (half of these false positives are lower than 1.2 m), and corners of walls and groups of posts as cars.
"""

import numpy as np

from asca_pillars.sim.bodies.people import parked_bicycle_body
from asca_pillars.sim.world.builder import Builder
from asca_pillars.sim.world.furniture import material
from asca_pillars.sim.world.vegetation import crown

FOIL = 0.5, 1.4  # reflectance of stickers and bands


def _foil(builder: Builder) -> float:
    return float(builder.rng.uniform(*FOIL))


def banded_bollards(builder: Builder, along: float, across: float) -> None:
    """Add a row of bollards along the kerb, half of the rows with a bright band, sometimes with a pole."""
    rng = builder.rng
    radius, tall, step = float(rng.uniform(0.05, 0.11)), float(rng.uniform(0.85, 1.1)), float(rng.uniform(1.1, 1.6))
    dark = float(rng.uniform(0.04, 0.4))
    band = (float(rng.uniform(0.6, tall - 0.25)), float(rng.uniform(0.12, 0.25))) if rng.random() < 0.5 else None
    foil = _foil(builder)
    for i in range(int(rng.integers(3, 11))):
        at = along + i * step
        if builder.near_junction(at, at) or not builder.reserve(at, across, 2 * radius, 2 * radius):
            continue
        high = float(rng.uniform(2.2, 2.9)) if rng.random() < 0.06 else tall
        builder.post(at, across, -0.2, high + 0.2, radius, dark)
        if band is not None:
            builder.post(at, across, band[0], band[1], radius + 0.01, foil)


def litter_bin(builder: Builder, along: float, across: float) -> None:
    """Add a bin on a post with a gap below, mostly with a sticker, sometimes with another object beside it."""
    rng = builder.rng
    wide, deep = float(rng.uniform(0.3, 0.45)), float(rng.uniform(0.28, 0.4))
    if not builder.reserve(along, across, 0.5, 0.5):
        return
    foot, top = float(rng.uniform(0.2, 0.45)), float(rng.uniform(0.9, 1.15))
    builder.post(along, across, -0.2, top + 0.2 + float(rng.choice([0.0, 0.1, 1.5])), 0.035, 0.3)
    paint, yaw = material(builder), float(rng.choice([0.0, 1.57]) + rng.normal(0, 0.15))
    builder.box(along, across + 0.1, foot, (wide, deep, top - foot), paint, yaw=yaw)
    if rng.random() < 0.6:
        size = (wide + 0.02, 0.5 * deep, float(rng.uniform(0.15, 0.3)))
        builder.box(along, across + 0.1, top - size[2] - 0.1, size, (_foil(builder), 0.3, 0.0), yaw=yaw)
    ahead = along + float(rng.uniform(0.6, 1.0))
    if rng.random() < 0.4 and builder.reserve(ahead, across, 0.7, 0.4):
        builder.box(ahead, across, -0.1, (0.6, 0.4, float(rng.uniform(0.8, 1.2)) + 0.1), material(builder), yaw=yaw)


def cabinet_and_panel(builder: Builder, along: float, across: float) -> None:
    """Add a low cabinet right beside a higher panel, sometimes with a bright sign on top."""
    rng = builder.rng
    if not builder.reserve(along, across, 1.3, 0.5):
        return
    deep, paint = float(rng.uniform(0.25, 0.4)), material(builder)
    low, high = float(rng.uniform(0.9, 1.2)), float(rng.uniform(1.4, 2.0))
    builder.box(along - 0.3, across, -0.1, (float(rng.uniform(0.5, 0.7)), deep, low + 0.1), paint)
    builder.box(along + 0.3, across, -0.1, (0.5, 0.4 * deep, high + 0.1), material(builder))
    if rng.random() < 0.4:
        builder.box(
            along + 0.3, across, high, (0.05, 0.4, 0.4), (_foil(builder), 0.3, 0.0), yaw=float(rng.uniform(0, 3.1))
        )


def before_a_wall(builder: Builder, along: float, across: float) -> None:
    """Add low pieces at up to an arm's length before a wall: a bench, a box hedge, a table, a bag."""
    rng = builder.rng
    length, side = float(rng.uniform(3.0, 8.0)), 1.0 if across > 0 else -1.0
    gap = float(rng.uniform(0.3, 0.8))
    if not builder.reserve(along, across + side * 0.3, length, 1.6):
        return
    stone = material(builder)
    builder.box(along, across + side * (0.4 + gap), -0.3, (length, 0.25, float(rng.uniform(1.5, 2.8)) + 0.3), stone)
    for _ in range(int(rng.integers(1, 4))):
        at = along + float(rng.uniform(-0.4, 0.4)) * length
        size = (float(rng.uniform(0.3, 1.9)), float(rng.uniform(0.2, 0.45)), float(rng.uniform(0.7, 1.25)))
        if rng.random() < 0.3:  # a plank on legs
            builder.box(at, across, size[2] - 0.08, (size[0], size[1], 0.08), material(builder))
            builder.box(at, across, -0.1, (0.1, size[1], size[2] + 0.02), material(builder))
        else:
            builder.box(at, across, -0.1, (size[0], size[1], size[2] + 0.1), material(builder))


def footed_trunk(builder: Builder, along: float, across: float) -> None:
    """Add a trunk or an advertising column that widens towards the ground, without visible branches."""
    rng = builder.rng
    radius, foot = float(rng.uniform(0.13, 0.26)), float(rng.uniform(0.3, 0.48))
    if not builder.reserve(along, across, 2 * foot, 2 * foot):
        return
    bark = float(rng.uniform(0.15, 0.45))
    tall = float(rng.uniform(2.0, 2.7) if rng.random() < 0.4 else rng.uniform(2.7, 6.0))
    builder.post(along, across, -0.2, tall, radius, bark, taper=float(rng.uniform(0.7, 1.0)))
    builder.post(along, across, -0.1, float(rng.uniform(0.3, 0.7)), foot, bark, taper=radius / foot)
    if tall > 2.7 and rng.random() < 0.6:
        crown(builder, along, across, tall, (1.6, 1.4), float(rng.uniform(0.3, 1.5)), cross=False)


def tapered_stone(builder: Builder, along: float, across: float) -> None:
    """Add a stone, a hydrant or a concrete cone: broad below, narrow above, as high as a person's chest."""
    rng = builder.rng
    foot = float(rng.uniform(0.2, 0.32))
    for i in range(int(rng.choice([1, 1, 2]))):
        at = along + i * float(rng.uniform(0.8, 2.5))
        if builder.reserve(at, across, 2 * foot, 2 * foot):
            tall, taper = float(rng.uniform(0.8, 1.4)), float(rng.uniform(0.35, 0.7))
            builder.post(at, across, -0.1, tall + 0.1, foot, float(rng.uniform(0.1, 0.5)), taper=taper)


def slim_pillars(builder: Builder, along: float, across: float) -> None:
    """Add an upright post or stone as tall as a person, without a head, and a lower one beside it or leaning on it."""
    rng = builder.rng
    if not builder.reserve(along, across, 1.2, 0.6):
        return
    radius, grey = float(rng.uniform(0.07, 0.15)), float(rng.uniform(0.15, 0.4))
    builder.post(along - 0.3, across, -0.2, float(rng.uniform(1.3, 1.75)) + 0.2, radius, grey)
    if rng.random() < 0.4:  # thicker below
        builder.post(along - 0.3, across, -0.1, float(rng.uniform(0.6, 1.25)), 2 * radius, grey)
    lean = float(rng.normal(0.0, 0.12))
    further_along, tall = along - 0.3 + float(rng.uniform(0.3, 0.8)), float(rng.uniform(0.5, 1.25))
    builder.post(further_along, across, -0.2, tall + 0.2, float(rng.uniform(0.06, 0.2)), grey, lean=(lean, 0.5 * lean))


def low_sign(builder: Builder, along: float, across: float) -> None:
    """Add a disc or a plate at a person's height on a post that mostly continues above; its back is dark."""
    rng = builder.rng
    if not builder.reserve(along, across, 0.6, 0.6):
        return
    size, foot = float(rng.uniform(0.22, 0.36)), float(rng.uniform(0.6, 1.7))
    bright = rng.random() < 0.6
    face = _foil(builder) if bright else float(rng.uniform(0.01, 0.2))
    up = foot + 2 * size
    builder.post(
        along, across, -0.2, up + 0.2 + float(rng.choice([0.0, 0.3, 1.0])), float(rng.uniform(0.025, 0.05)), 0.3
    )
    if rng.random() < 0.6:
        builder.ball(along, across, foot + size, (0.04, size, size), face)
    else:
        yaw = float(rng.choice([0.0, 0.0, 1.57]) + rng.normal(0, 0.3))
        builder.box(along, across, foot, (0.05, 2 * size, 2 * size), (face, 0.3, 0.0), yaw=yaw)


def warning_barrier(builder: Builder, along: float, across: float) -> None:
    """Add a bright board across the line of sight on legs with hardly any returns, or on a tripod."""
    rng = builder.rng
    wide = float(rng.uniform(0.5, 1.7))
    if not builder.reserve(along, across, 0.6, wide):
        return
    foot, tall = float(rng.uniform(0.6, 0.9)), float(rng.uniform(0.2, 0.5))
    yaw = float(rng.normal(0.0, 0.4))
    builder.box(along, across, foot, (0.04, wide, tall), (_foil(builder), 0.3, 0.0), yaw=yaw)
    for lateral in (-0.4 * wide, 0.4 * wide):
        builder.post(along, across + lateral, -0.1, foot + 0.1, 0.015, 0.05, lean=(float(rng.normal(0, 0.15)), 0.0))


def bicycle_at_post(builder: Builder, along: float, across: float) -> None:
    """Add a parked bicycle leaning on a post or a trunk, which is visible on both sides."""
    rng = builder.rng
    if not builder.reserve(along, across, 1.8, 0.7):
        return
    thick = float(rng.uniform(0.04, 0.2))
    builder.post(along + float(rng.normal(0, 0.2)), across, -0.2, float(rng.uniform(1.9, 4.0)), thick, 0.3)
    body = parked_bicycle_body(rng)
    builder.body(body, along, across + float(rng.choice([-1.0, 1.0])) * (thick + 0.15), float(rng.normal(0.0, 0.15)))


def wall_corner(builder: Builder, along: float, across: float) -> None:
    """Add the corner of a low wall, a raised bed or a clipped hedge, open behind: two faces like those of a car."""
    rng = builder.rng
    long, short = float(rng.uniform(2.0, 4.5)), float(rng.uniform(1.2, 2.2))
    if not builder.reserve(along, across, long, short):
        return
    stone, tall, thick = material(builder), float(rng.uniform(0.4, 1.1)), float(rng.uniform(0.12, 0.4))
    side, end = (1.0 if across > 0 else -1.0), float(rng.choice([-0.5, 0.5]))
    builder.box(along, across - side * (short - thick) / 2, -0.2, (long, thick, tall + 0.2), stone)
    builder.box(along + end * (long - thick), across, -0.2, (thick, short, tall + 0.2), stone)
    if rng.random() < 0.3:
        builder.box(along, across, -0.2, (long, short, 0.8 * tall + 0.2), stone)


def posts_at_corners(builder: Builder, along: float, across: float) -> None:
    """Add three or four low objects near the corners of an absent parked car."""
    rng = builder.rng
    long, wide = float(rng.uniform(3.0, 4.6)), float(rng.uniform(1.3, 1.9))
    if not builder.reserve(along, across, long, wide):
        return
    for at in (-0.5, 0.5):
        for lateral in (-0.5, 0.5):
            if rng.random() < 0.85:
                place = (
                    along + at * long + float(rng.normal(0, 0.2)),
                    across + lateral * wide + float(rng.normal(0, 0.1)),
                )
                tall, radius = float(rng.uniform(0.4, 1.3)), float(rng.uniform(0.05, 0.25))
                builder.post(
                    *place,
                    -0.2,
                    tall + 0.2,
                    radius,
                    float(rng.uniform(0.05, 0.5)),
                    taper=float(np.sqrt(rng.uniform(0.4, 1.0))),
                )
