"""Unlabelled things of the size, though not of the shape, of persons, bicycles and cars."""

import numpy as np

from asca_pillars.sim.bodies.cycles import motorbike_body, parked_bicycle_body
from asca_pillars.sim.world.builder import Builder, Material
from asca_pillars.sim.world.furniture import material


def thin_cylinder(builder: Builder, along: float, across: float) -> None:
    """A round thing as tall as a person: a stump, a pipe, a rolled carpet, a wrapped tree."""
    rng = builder.rng
    radius = float(rng.uniform(0.08, 0.28))
    if builder.claim(along, across, 2 * radius, 2 * radius):
        taper, lean = float(rng.uniform(0.5, 1.1)), rng.normal(0.0, 0.05, 2)
        builder.post(
            along,
            across,
            -0.2,
            float(rng.uniform(0.9, 2.4)),
            radius,
            float(rng.uniform(0.08, 0.6)),
            taper=taper,
            lean=(float(lean[0]), float(lean[1])),
        )


def post_with_box(builder: Builder, along: float, across: float) -> None:
    """A parking meter, a letter box, a counter, a pump, a bird house: something wide on something thin."""
    rng = builder.rng
    size = (float(rng.uniform(0.15, 0.5)), float(rng.uniform(0.2, 0.6)), float(rng.uniform(0.25, 0.9)))
    if builder.claim(along, across, 0.5, 0.5):
        top = float(rng.uniform(0.9, 2.1))
        builder.post(along, across, -0.2, top, float(rng.uniform(0.03, 0.1)), float(rng.uniform(0.1, 0.5)))
        builder.box(along, across, top - size[2], size, material(builder), yaw=float(rng.uniform(0, 3.1)))


def column(builder: Builder, along: float, across: float) -> None:
    """An upright slab or pillar: a stone, a gate's pillar, an advertising stele, a stack of chairs."""
    rng = builder.rng
    size = (float(rng.uniform(0.2, 0.7)), float(rng.uniform(0.15, 0.7)), float(rng.uniform(1.0, 2.4)))
    if builder.claim(along, across, 0.8, 0.8):
        builder.box(
            along, across, -0.2, (size[0], size[1], size[2] + 0.2), material(builder), yaw=float(rng.uniform(0, 3.1))
        )


def container(builder: Builder, along: float, across: float) -> None:
    """A skip, a container for glass or clothes, a building site's box, a small transformer house."""
    rng = builder.rng
    length, width = float(rng.uniform(1.2, 6.0)), float(rng.uniform(1.0, 2.4))
    height = float(rng.uniform(0.9, 2.7))
    if not builder.claim(along, across, length, width):
        return
    paint = material(builder)
    if rng.random() < 0.5:
        builder.box(along, across, -0.1, (length, width, height + 0.1), paint)
    else:  # an open skip, whose ends slope outward: a smaller foot below a larger rim
        builder.box(along, across, -0.1, (0.65 * length, 0.9 * width, height + 0.1), paint)
        builder.box(along, across, 0.45 * height, (0.85 * length, 0.95 * width, 0.3 * height), paint)
        builder.box(along, across, 0.72 * height, (length, width, 0.28 * height), paint)


def heap(builder: Builder, along: float, across: float) -> None:
    """Earth, gravel, leaves, boulders, bags: low round mounds."""
    rng = builder.rng
    wide = float(np.exp(rng.uniform(np.log(0.2), np.log(2.4))))
    if not builder.claim(along, across, 1.6 * wide, 1.2 * wide):
        return
    reflectance, tall = float(rng.uniform(0.15, 0.5)), float(rng.uniform(0.25, 0.6)) * wide
    for _ in range(int(rng.integers(2, 7))):
        shift, size = rng.normal(0.0, 0.25, 2) * wide, rng.uniform(0.3, 0.6, 3)
        radii = (float(size[0]) * wide, float(size[1]) * 0.8 * wide, float(size[2] + 0.4) * tall)
        builder.ball(along + float(shift[0]), across + 0.6 * float(shift[1]), 0.0, radii, reflectance)


def stack(builder: Builder, along: float, across: float) -> None:
    """Pallets, timber, bricks, boxes: uneven blocks on and beside each other."""
    rng = builder.rng
    length, width, height = float(rng.uniform(0.6, 4.5)), float(rng.uniform(0.5, 1.8)), float(rng.uniform(0.5, 1.9))
    if not builder.claim(along, across, length, width):
        return
    paint: Material = material(builder)
    columns, layers = max(int(length / 1.1), 1), max(int(height / 0.4), 1)
    for i in range(columns):
        top = int(rng.integers(max(layers - 2, 1), layers + 1))
        for j in range(top):
            at = along + (i + 0.5) * length / columns - length / 2 + float(rng.normal(0, 0.03))
            size = (0.93 * length / columns, width * float(rng.uniform(0.75, 1.0)), 0.36)
            builder.box(
                at, across + float(rng.normal(0, 0.03)), 0.4 * j - 0.02, size, paint, yaw=float(rng.normal(0, 0.03))
            )


def parked_bicycles(builder: Builder, along: float, across: float) -> None:
    """Bicycles without riders, which KITTI does not label: a few, or a rack full of them."""
    rng = builder.rng
    leaning = np.pi / 2 if rng.random() < 0.6 else 0.0
    number = int(rng.integers(4, 12)) if leaning and rng.random() < 0.4 else int(rng.integers(1, 5))
    step = float(rng.uniform(0.45, 0.8)) if leaning else 2.0
    length, width = (0.4, 1.75) if leaning else (1.75, 0.55)
    bodies = [parked_bicycle_body(rng) for _ in range(min(number, 2))]  # racks repeat them: they are dear to draw
    for i in range(number):
        place = along + i * step
        if builder.claim(place, across, length, width):
            builder.body(bodies[i % 2], place, across, leaning + float(rng.choice([0.0, np.pi]) + rng.normal(0, 0.12)))


def parked_motorbikes(builder: Builder, along: float, across: float) -> None:
    """One to four motorcycles side by side."""
    rng = builder.rng
    turned = float(rng.choice([0.0, 0.9, np.pi / 2]))
    length, width = (2.0, 0.8) if turned == 0.0 else (0.9, 2.1)
    for place in along + (2.3 if turned == 0.0 else 1.0) * np.arange(int(rng.integers(1, 5))):
        if builder.claim(place, across, length, width):
            builder.body(motorbike_body(rng), place, across, turned + float(rng.normal(0, 0.1)))
