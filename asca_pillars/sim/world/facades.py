"""Houses, garages, sheds and open roofs beside the street."""

import numpy as np

from asca_pillars.sim.world.builder import Builder, Material, Stretch
from asca_pillars.sim.world.vegetation import wood_across


def building(builder: Builder, stretch: Stretch) -> None:
    """Houses side by side, some a little forward or back, some with a passage between them."""
    rng = builder.rng
    depth, height = float(rng.uniform(5.0, 10.0)), float(rng.uniform(3.2, 9.0))
    width = stretch.length_m / max(int(stretch.length_m // 8.0), 1)
    uneven = float(rng.choice([0.0, 0.0, 0.4, 1.2]))
    for middle in stretch.along(width):
        away = stretch.away_m + uneven * rng.random()
        passage = 0.0 if rng.random() < 0.7 else float(rng.uniform(0.8, 3.0))
        if builder.claim(middle, stretch.side * (away + 0.2 + depth / 2), 0.9 * width, depth, stretch.cross):
            _house(builder, middle, stretch.side, away, (width - passage, depth, height), stretch.cross)


def _house(
    builder: Builder, middle: float, side: float, away: float, size: tuple[float, float, float], cross: bool
) -> None:
    """A core with recessed windows behind pillars, plinth and lintel; steps, balconies, awnings, drainpipes."""
    rng, (width, depth, height) = builder.rng, size
    recess = float(rng.uniform(0.06, 0.35))
    stone: Material = (float(rng.uniform(0.2, 0.6)), 0.3, 0.0)
    glass: Material = (float(rng.uniform(0.03, 0.25)), 2.0, float(rng.choice([0.0, 0.0, 0.1])))
    front, core = side * (away + recess / 2), side * (away + recess + depth / 2)
    builder.box(middle, core, -1.5, (width, depth, height + 1.0), glass, cross)
    plinth, lintel = float(rng.uniform(0.4, 1.4)), float(rng.uniform(2.1, 2.9))
    builder.box(middle, front, -1.5, (width, recess, plinth + 1.5), stone, cross)
    builder.box(middle, front, lintel, (width, recess, max(height - lintel - 1.0, 0.1)), stone, cross)
    step = float(rng.uniform(1.8, 3.4))
    pillar = float(rng.uniform(0.35, 0.85)) * step
    for along in np.arange(middle - width / 2 + pillar / 2, middle + width / 2, step):
        builder.box(along, front, -1.5, (min(pillar, width), recess + 0.02, height), stone, cross)
    _before_house(builder, middle + rng.uniform(-0.4, 0.4) * width, side, away, stone, cross)
    if rng.random() < 0.5:
        pipe = middle + rng.uniform(-0.5, 0.5) * width
        builder.post(pipe, side * (away - 0.08), -0.1, 5.0, 0.05, 0.3, cross)


def _before_house(builder: Builder, place: float, side: float, away: float, stone: Material, cross: bool) -> None:
    rng = builder.rng
    extra, long = rng.random(), float(rng.uniform(1.2, 3.0))
    if extra < 0.25:  # stairs
        steps = int(rng.integers(1, 5))
        if builder.claim(place, side * (away - 0.15 * steps), long, 0.3 * steps, cross):
            for i in range(steps):
                deep = 0.3 * (steps - i)
                builder.box(place, side * (away - deep / 2), -0.3, (long, deep, 0.3 + 0.17 * (i + 1)), stone, cross)
    elif extra < 0.4:  # balcony
        builder.box(place, side * (away - 0.5), 2.3, (long, 1.0, 1.1), stone, cross)
    elif extra < 0.5:  # awning
        builder.box(place, side * (away - 0.7), 2.2, (1.5 * long, 1.4, 0.12), (0.4, 0.3, 0.0), cross)
    elif extra < 0.62 and builder.claim(place, side * (away - 0.35), long, 0.7, cross):  # bay window
        builder.box(place, side * (away - 0.35), -0.5, (long, 0.7, 4.0), stone, cross)
    elif extra < 0.7 and builder.claim(place, side * (away - 0.6), 0.2, 0.2, cross):  # porch
        builder.post(place, side * (away - 0.7), -0.2, 2.6, 0.07, stone[0], cross)
        builder.box(place, side * (away - 0.5), 2.3, (2.0, 1.2, 0.2), stone, cross)


def close_view(builder: Builder, along: float, half_width: float) -> None:
    """What stands across the end of a street: a wood or a house."""
    rng = builder.rng
    if rng.random() < 0.6:
        wood_across(builder, along, half_width)
        return
    stone: Material = (float(rng.uniform(0.2, 0.6)), 0.3, 0.0)
    glass: Material = (float(rng.uniform(0.03, 0.25)), 2.0, 0.0)
    wide, toward = float(rng.uniform(9.0, 20.0)), -1.0 if along > 0 else 1.0
    middle = float(rng.normal(0.0, 3.0))
    if builder.claim(along, middle, 6.0, wide):
        builder.box(along, middle, -1.5, (6.0, wide, 9.0), glass)
        front = along + 3.1 * toward
        builder.box(front, middle, -1.5, (0.2, wide, 2.3), stone)
        builder.box(front, middle, 2.4, (0.2, wide, 5.0), stone)
        for across in np.arange(middle - wide / 2 + 0.5, middle + wide / 2, float(rng.uniform(1.8, 3.2))):
            builder.box(front, across, -1.5, (0.22, 1.0, 7.0), stone)


def garages(builder: Builder, stretch: Stretch) -> None:
    """Flat boxes with recessed gates, open ones here and there, set back from the street."""
    rng, side, cross = builder.rng, stretch.side, stretch.cross
    height, depth = float(rng.uniform(2.1, 2.7)), float(rng.uniform(4.5, 6.5))
    stone: Material = (float(rng.uniform(0.2, 0.6)), 0.3, 0.0)
    gate: Material = (float(rng.uniform(0.1, 0.4)), 0.5, 0.0)
    away = stretch.away_m + float(rng.choice([0.0, 2.0, 5.0]))
    for along in stretch.along(3.0):
        if not builder.claim(along, side * (away + depth / 2), 2.9, depth, cross):
            continue
        recess = float(rng.uniform(0.1, 0.5)) if rng.random() < 0.85 else depth - 0.4
        builder.box(
            along, side * (away + recess + (depth - recess) / 2), -0.5, (3.0, depth - recess, height), gate, cross
        )
        builder.box(along, side * (away + depth / 2), height - 0.35, (3.0, depth, 0.35), stone, cross)
        for edge in (-1.4, 1.4):
            builder.box(along + edge, side * (away + depth / 2), -0.5, (0.3, depth, height + 0.4), stone, cross)


def open_roof(builder: Builder, stretch: Stretch) -> None:
    """A carport, a pergola, a petrol station: a roof on posts."""
    rng, side, cross = builder.rng, stretch.side, stretch.cross
    deep, height = float(rng.uniform(2.5, 6.0)), float(rng.uniform(2.0, 3.5))
    beam: Material = (float(rng.uniform(0.15, 0.5)), 0.3, float(rng.choice([0.0, 0.5])))
    radius = float(rng.uniform(0.04, 0.15))
    for along in stretch.along(float(rng.uniform(2.0, 4.0))):
        for away in (0.1, deep - 0.1):
            if builder.claim(along, side * (stretch.away_m + away), 2 * radius, 2 * radius, cross):
                builder.post(along, side * (stretch.away_m + away), -0.2, height + 0.2, radius, beam[0], cross)
    middle = side * (stretch.away_m + deep / 2)
    builder.box(stretch.middle_m, middle, height, (stretch.length_m, deep, 0.2), beam, cross)


def scaffolding(builder: Builder, stretch: Stretch) -> None:
    """Thin tubes and planks before a wall."""
    rng, side, cross = builder.rng, stretch.side, stretch.cross
    wood: Material = (float(rng.uniform(0.22, 0.6)), 0.3, 0.0)
    net: Material = (0.25, 0.3, float(rng.choice([0.6, 0.9, 1.0])))
    building(builder, Stretch(stretch.start_m, stretch.length_m, side, stretch.away_m + 1.3, cross))
    for along in stretch.along(2.2):
        for away in (0.0, 0.8):
            if builder.claim(along, side * (stretch.away_m + away), 0.08, 0.08, cross):
                builder.post(along, side * (stretch.away_m + away), -0.1, 6.0, 0.03, 0.4, cross)
        for level in (0.15, 2.1):
            builder.box(along, side * (stretch.away_m + 0.4), level, (2.2, 0.7, 0.05), wood, cross)
            builder.box(along, side * stretch.away_m, level + 0.95, (2.2, 0.04, 0.06), wood, cross)
        builder.box(along, side * (stretch.away_m - 0.03), 0.2, (2.2, 0.01, 5.0), net, cross)
