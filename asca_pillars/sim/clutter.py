"""Things on pavements and verges, much of it the size of a person: what a detector must not take for one."""

import numpy as np

from .builder import Builder
from .roadside import shrub, tree
from .shapes.people import bicycle


def scatter(builder: Builder) -> None:
    """Clutter along both sides of the main road, more of it right behind the kerb."""
    rng, half, pavement = builder.rng, builder.ground.half_width_m, builder.ground.pavement_m
    for _ in range(rng.poisson(1.6 * rng.uniform(*builder.config.clutter))):  # 160 m of street
        along = float(rng.uniform(-80, 80))
        side = 1.0 if rng.random() < 0.5 else -1.0
        beside = rng.uniform(0.25, 0.7) if rng.random() < 0.4 else rng.uniform(0.3, pavement + 6.0)
        if not builder.near_junction(along, along):
            _thing(builder, along, side * (half + beside))


def _thing(builder: Builder, along: float, across: float) -> None:
    what = builder.rng.random()
    if what < 0.30:
        _pole(builder, along, across)
    elif what < 0.42:
        _bollards(builder, along, across)
    elif what < 0.60:
        _cabinet(builder, along, across)
    elif what < 0.72:
        _figure(builder, along, across)
    elif what < 0.77:
        _parked_bicycles(builder, along, across)
    elif what < 0.94:
        shrub(builder, along, across, tall=bool(builder.rng.random() < 0.35))
    else:
        tree(builder, along, across)


def _pole(builder: Builder, along: float, across: float) -> None:
    """A lamp, a sign or a traffic light."""
    rng = builder.rng
    radius = float(rng.uniform(0.035, 0.12))
    if not builder.claim(along, across, 2 * radius, 2 * radius):
        return
    builder.post(along, across, -0.2, float(rng.uniform(2.2, 6.0)), radius, float(rng.uniform(0.1, 0.6)), taper=0.8)
    plate = rng.random()
    if plate < 0.5:  # signs send back nearly everything
        size = float(rng.uniform(0.4, 0.9))
        z, yaw = float(rng.uniform(1.4, 2.6)), float(rng.normal(0, 0.3))
        builder.box(along, across, z, (0.04, size, size), (0.8, 0.4, 0.0), yaw=yaw)
    elif plate < 0.65:
        builder.box(along, across, float(rng.uniform(1.8, 2.6)), (0.25, 0.3, 0.9), (0.15, 0.4, 0.0))


def _bollards(builder: Builder, along: float, across: float) -> None:
    rng = builder.rng
    radius, height = float(rng.uniform(0.04, 0.16)), float(rng.uniform(0.8, 1.3))
    reflectance = float(rng.uniform(0.1, 0.6))
    for place in along + 1.5 * np.arange(rng.integers(1, 6)):
        if builder.claim(place, across, 2 * radius, 2 * radius):
            builder.post(place, across, -0.2, height, radius, reflectance)


def _cabinet(builder: Builder, along: float, across: float) -> None:
    """A switch cabinet, a bin, a post box, a stone, a bench."""
    rng = builder.rng
    size = (float(rng.uniform(0.25, 1.4)), float(rng.uniform(0.25, 0.6)), float(rng.uniform(0.6, 1.9)))
    if builder.claim(along, across, *size[:2]):
        material = (float(rng.uniform(0.1, 0.6)), 0.5, 0.0)
        builder.box(along, across, -0.2, size, material, yaw=float(rng.normal(0, 0.1)))


def _figure(builder: Builder, along: float, across: float) -> None:
    """A column of a person's height and width, with something like a head."""
    rng = builder.rng
    width, height = float(rng.uniform(0.25, 0.7)), float(rng.uniform(1.0, 2.1))
    reflectance = float(rng.uniform(0.1, 0.6))
    if builder.claim(along, across, width, width):
        taper = float(rng.uniform(0.4, 1.0))
        builder.post(along, across, -0.2, 0.85 * height, width / 2, reflectance, taper=taper)
        builder.blob(along, across, 0.88 * height, (0.12, 0.12, 0.13 * height), reflectance, 0.0)


def _parked_bicycles(builder: Builder, along: float, across: float) -> None:
    """Bicycles without riders, which KITTI does not label."""
    rng = builder.rng
    leaning = np.pi / 2 if rng.random() < 0.6 else 0.0
    for place in along + (0.7 if leaning else 2.0) * np.arange(rng.integers(1, 5)):
        length, width = (0.55, 1.75) if leaning else (1.75, 0.55)
        if builder.claim(place, across, length, width):
            builder.body(
                bicycle(rng, float(rng.uniform(1.6, 1.85))), place, across, leaning + float(rng.normal(0, 0.12))
            )
