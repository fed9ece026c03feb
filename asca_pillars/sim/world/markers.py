"""Beacons, striped boards, masts: upright and often retroreflective, and of a person's size in all but shape.

Most of what KITTI's detectors take for people is one of them.
"""

import numpy as np

from asca_pillars.sim.world.builder import Builder, Material
from asca_pillars.sim.world.furniture import material, wrapped


def retroreflective(builder: Builder) -> Material:
    """Foil that sends light back to where it came from: the sensor reports 0.6 to 0.99, far away too."""
    return (float(np.exp(builder.rng.uniform(np.log(0.8), np.log(5.0)))), 0.3, 0.0)


def beacon(builder: Builder, along: float, across: float) -> None:
    """Guidance beacons on feet, in a row or alone: a board as wide as a leg, as tall as a child."""
    rng = builder.rng
    size = (0.06, float(rng.uniform(0.2, 0.35)), float(rng.uniform(0.7, 1.15)))
    foil, step = retroreflective(builder), float(rng.uniform(2.5, 8.0))
    yaw = float(rng.choice([0.0, 0.0, 1.57]) + rng.normal(0, 0.3))
    for i in range(int(rng.choice([1, 1, 1, 2, 4]))):
        at = along + i * step
        if not builder.near_junction(at, at) and builder.claim(at, across, 0.4, 0.4):
            foot = float(rng.uniform(0.08, 0.3))
            builder.box(at, across, -0.05, (0.4, 0.35, 0.15), (0.1, 0.3, 0.0), yaw=yaw)
            builder.box(at, across, foot, size, foil, yaw=yaw)
            if rng.random() < 0.3:  # a lamp on top
                builder.ball(at, across, foot + size[2] + 0.08, (0.09, 0.09, 0.11), 0.6)


def striped_post(builder: Builder, along: float, across: float) -> None:
    """A round or square post in bands, every other one of foil, with a cap, a sign or nothing on it."""
    rng = builder.rng
    wide, tall = float(rng.uniform(0.12, 0.35)), float(rng.uniform(0.8, 1.5))
    if not builder.claim(along, across, wide, wide):
        return
    foil, paint = retroreflective(builder), material(builder)
    bands = int(rng.integers(2, 6))
    round_one = rng.random() < 0.5
    for i in range(bands):
        band = foil if i % 2 else paint
        z, height = -0.1 + i * (tall + 0.1) / bands, (tall + 0.1) / bands
        if round_one:
            builder.post(along, across, z, height, wide / 2, band[0])
        else:
            builder.box(along, across, z, (wide, wide, height), band)
    if rng.random() < 0.35:
        size = float(rng.uniform(0.25, 0.6))
        builder.box(along, across, tall, (0.05, size, size), foil, yaw=float(rng.normal(0, 0.4)))


def board(builder: Builder, along: float, across: float) -> None:
    """A narrow upright board near the ground: a striped plate, an arrow, a poster, some of them retroreflective."""
    rng = builder.rng
    size = (0.05, float(rng.uniform(0.2, 0.55)), float(rng.uniform(0.8, 1.5)))
    if not builder.claim(along, across, size[1], size[1]):
        return
    face = retroreflective(builder) if rng.random() < 0.6 else material(builder)
    foot = float(rng.uniform(0.0, 0.5))
    yaw = float(rng.choice([0.0, 1.57]) + rng.normal(0, 0.35))
    builder.box(along, across, foot, size, face, yaw=yaw)
    builder.post(along, across, -0.2, foot + 0.4 * size[2] + 0.2, 0.035, 0.35)


def leaning_board(builder: Builder, along: float, across: float) -> None:
    """A board, a plank or a sheet that leans on a post: stacked slices, each a little farther from the foot."""
    rng = builder.rng
    wide, tall = float(rng.uniform(0.25, 0.7)), float(rng.uniform(0.9, 1.8))
    if not builder.claim(along, across, 0.8, 0.8):
        return
    face, slices, lean = material(builder), 5, float(rng.uniform(0.15, 0.45))
    for i in range(slices):
        beside = across + lean * tall * (i / slices - 0.5)
        builder.box(along, beside, i * tall / slices, (wide, 0.08, tall / slices), face)
    builder.post(along, across + 0.5 * lean * tall + 0.1, -0.2, float(rng.uniform(1.5, 4.0)), 0.05, 0.35)


def mast(builder: Builder, along: float, across: float) -> None:
    """A mast, thin or thick, with boxes as high as a person, bands of tape, notices and a foot wider than itself."""
    rng = builder.rng
    radius = float(rng.uniform(0.03, 0.09) if rng.random() < 0.6 else rng.uniform(0.09, 0.28))
    if not builder.claim(along, across, 0.6, 0.6):
        return
    builder.post(along, across, -0.3, float(rng.uniform(2.4, 7.0)), radius, float(rng.uniform(0.15, 0.5)), taper=0.85)
    if rng.random() < 0.6:
        builder.post(along, across, -0.2, float(rng.uniform(0.3, 1.2)), 1.5 * radius, float(rng.uniform(0.15, 0.5)))
    z = float(rng.uniform(0.2, 0.8))
    for _ in range(int(rng.integers(1, 4))):
        size = (float(rng.uniform(0.15, 0.4)), float(rng.uniform(0.25, 0.6)), float(rng.uniform(0.25, 0.8)))
        turn = float(rng.uniform(0, 2 * np.pi))
        at, beside = along + radius * np.cos(turn), across + radius * np.sin(turn)
        builder.box(float(at), float(beside), z, size, material(builder), yaw=turn)
        z += size[2] * float(rng.uniform(0.6, 1.2))
    if rng.random() < 0.5:  # tape or a notice
        z, height = float(rng.uniform(0.5, 1.6)), float(rng.uniform(0.1, 0.5))
        builder.post(along, across, z, height, radius + 0.02, retroreflective(builder)[0])


def covered_thing(builder: Builder, along: float, across: float) -> None:
    """Something under a sheet, in a sack or wound with plants: a pump, a statue, stacked chairs, a parasol.

    Some of it is tied to a pole.
    """
    rng = builder.rng
    wide, tall = float(rng.uniform(0.14, 0.34)), float(rng.uniform(0.9, 1.9))
    if not builder.claim(along, across, 2.2 * wide, 2.2 * wide):
        return
    wrapped(builder, along, across, wide, tall)
    if rng.random() < 0.4:
        aside = float(rng.normal(0.0, wide))
        builder.post(along + aside, across, -0.2, float(rng.uniform(2.2, 5.0)), float(rng.uniform(0.03, 0.09)), 0.35)


def wall_end(builder: Builder, along: float, across: float) -> None:
    """Where a wall ends: a stub, a pillar before it, a gap."""
    rng = builder.rng
    length, thick, tall = float(rng.uniform(0.3, 1.6)), float(rng.uniform(0.15, 0.4)), float(rng.uniform(0.7, 2.2))
    if builder.claim(along, across, length, length):
        stone = material(builder)
        yaw = float(rng.choice([0.0, 1.57]) + rng.normal(0, 0.1))
        builder.box(along, across, -0.3, (length, thick, tall + 0.3), stone, yaw=yaw)
        if rng.random() < 0.5:
            beside = across + (0.5 * length if yaw > 0.8 else 0.0)
            builder.box(
                along if yaw > 0.8 else along + 0.5 * length,
                beside,
                -0.3,
                (thick + 0.12, thick + 0.12, tall + 0.5),
                stone,
            )


def fragments(builder: Builder, along: float, across: float) -> None:
    """Some uneven pieces close together, of which a distant sensor catches a few returns each."""
    rng = builder.rng
    tall = float(rng.uniform(0.3, 1.9))
    for _ in range(int(rng.integers(1, 4))):
        at, beside = along + float(rng.normal(0, 0.4)), across + float(rng.normal(0, 0.4))
        size = (float(rng.uniform(0.08, 0.4)), float(rng.uniform(0.08, 0.4)), tall * float(rng.uniform(0.4, 1.0)))
        if builder.claim(at, beside, size[0], size[1]):
            foot = 0.0 if rng.random() < 0.7 else float(rng.uniform(0.1, 0.6))
            builder.box(at, beside, foot - 0.05, size, material(builder), yaw=float(rng.uniform(0, 3.1)))


def low_pieces(builder: Builder, along: float, across: float) -> None:
    """Things hardly higher than a kerb, thinly strewn."""
    rng = builder.rng
    for _ in range(int(rng.integers(1, 6))):
        at, beside = along + float(rng.normal(0, 1.5)), across + float(rng.normal(0, 1.0))
        size = (float(rng.uniform(0.15, 1.0)), float(rng.uniform(0.15, 0.6)), float(rng.uniform(0.1, 0.7)))
        if builder.claim(at, beside, size[0], size[1]):
            builder.box(at, beside, -0.1, (size[0], size[1], size[2] + 0.1), material(builder))
