"""Distractors (domain randomization, Tobin et al., arXiv 1703.06907): random compositions as large as a person.

The other kinds of clutter are things that detectors were seen to take for people; real streets have more kinds.
"""

import numpy as np

from asca_pillars.sim.world.builder import Builder, Material

_LEAFY, _FLOATING, _ON_A_POST, _GOES_ON, _BEFORE_A_WALL = 0.25, 0.4, 0.6, 0.2, 0.3  # probabilities


def distractor(builder: Builder, along: float, across: float) -> None:
    """Add boxes, posts and balls, or clouds of leaves, on and beside each other: 0.2 to 0.9 m wide, 0.8 to 2.3 m tall.

    Some begin above the ground, on a thin post or on nothing that returns; some stand before a wall, or a post goes on
    above them.
    """
    rng = builder.rng
    wide, top = float(rng.uniform(0.2, 0.9)), float(rng.uniform(0.8, 2.3))
    if not builder.reserve(along, across, wide, wide):
        return
    foot = float(rng.uniform(0.15, 0.75)) * top if rng.random() < _FLOATING else 0.0
    shared = _surface(builder) if rng.random() < 0.6 else None
    leafy = rng.random() < _LEAFY
    pieces = int(rng.integers(1, 7))
    shares = (0.2, 1.0) if pieces > 1 else (1.0, 1.0)
    for number in range(pieces):
        tall = (top - foot) * float(rng.uniform(*shares))
        # The first piece reaches the top and the second one the foot.
        low = foot + (top - foot - tall) * (1.0, 0.0, float(rng.random()))[min(number, 2)]
        width = wide * float(rng.uniform(*shares))
        at, lateral = np.array([along, across]) + rng.uniform(-0.5, 0.5, 2) * (wide - width)
        surface = shared or _surface(builder)
        (_cloud if leafy else _solid)(builder, (float(at), float(lateral), low), (width, tall), surface)
    if foot and rng.random() < _ON_A_POST:
        builder.post(along, across, -0.2, foot + 0.3, float(rng.uniform(0.015, 0.06)), 0.3)
    if rng.random() < _GOES_ON:
        builder.post(along, across, -0.2, float(rng.uniform(2.3, 5.0)), float(rng.uniform(0.02, 0.08)), 0.3)
    if rng.random() < _BEFORE_A_WALL:
        _wall_behind(builder, along, across, 0.5 * wide)


def _surface(builder: Builder) -> Material:
    rng = builder.rng
    usual = float(rng.uniform(0.06, 0.6))
    dark_or_bright = float(np.exp(rng.uniform(np.log(0.02), np.log(0.9))))
    return (usual if rng.random() < 0.5 else dark_or_bright, 0.4, 0.0)


def _cloud(builder: Builder, place: tuple[float, float, float], size: tuple[float, float], surface: Material) -> None:
    rng, (along, across, low), (width, tall) = builder.rng, place, size
    radii = np.array([[0.5 * width, 0.5 * width * rng.uniform(0.5, 1.0), 0.5 * tall]])
    density = np.exp(rng.uniform(np.log(2.0), np.log(12.0), 1))
    builder.clouds(np.array([along]), np.array([across]), np.array([low + 0.5 * tall]), radii, surface[0], density)


def _solid(builder: Builder, place: tuple[float, float, float], size: tuple[float, float], surface: Material) -> None:
    rng, (along, across, low), (width, tall) = builder.rng, place, size
    kind = rng.random()
    if kind < 0.4:
        depth = width * float(rng.uniform(0.15, 1.0))
        builder.box(along, across, low, (width, depth, tall), surface, yaw=float(rng.uniform(0, np.pi)))
    elif kind < 0.7:
        lean = (float(rng.normal(0.0, 0.1)), float(rng.normal(0.0, 0.1)))
        taper = float(rng.uniform(0.4, 1.2))
        builder.post(along, across, low, tall, 0.5 * width, surface[0], taper=taper, lean=lean)
    else:
        radii = (0.5 * width, 0.5 * width * float(rng.uniform(0.4, 1.0)), 0.5 * tall)
        builder.ball(along, across, low + 0.5 * tall, radii, surface[0])


def _wall_behind(builder: Builder, along: float, across: float, reach_m: float) -> None:
    """Add a wall 0.1 to 0.9 m behind what reaches so far, seen from the road."""
    rng, side = builder.rng, 1.0 if across > 0 else -1.0
    length, tall, thick = float(rng.uniform(1.5, 6.0)), float(rng.uniform(1.0, 3.0)), 0.3
    lateral = across + side * (reach_m + float(rng.uniform(0.1, 0.9)) + thick / 2)
    stone: Material = (float(rng.uniform(0.1, 0.5)), 0.4, 0.0)
    builder.box(along + float(rng.uniform(-0.5, 0.5)) * length, lateral, -0.3, (length, thick, tall + 0.3), stone)
