"""What lines the streets: facades, walls, fences, hedges, trees, woods, guard rails, and what closes the view."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from .builder import Builder, Stretch


def line_streets(builder: Builder) -> None:
    """Both sides of both roads, and houses and woods far behind them."""
    ground, rng = builder.ground, builder.rng
    half, pavement = ground.half_width_m, ground.pavement_m
    for side in (1.0, -1.0):
        _line(builder, Stretch(-85.0, 170.0, side, half + pavement))
        if ground.cross_half_m > 0:
            edge = ground.cross_half_m + pavement
            beyond = half + pavement + 5.0
            _line(builder, Stretch(beyond, 70.0 - beyond, side, edge, cross=True))
            _line(builder, Stretch(-70.0, 70.0 - beyond, side, edge, cross=True))
    for _ in range(int(rng.integers(14, 30))):
        side = 1.0 if rng.random() < 0.5 else -1.0
        far = Stretch(float(rng.uniform(-80, 80)), float(rng.uniform(6, 20)), side, float(rng.uniform(half + 18, 70)))
        if not builder.near_junction(far.start_m, far.start_m + far.length_m):
            (building if rng.random() < 0.45 else wood)(builder, far)


def _line(builder: Builder, whole: Stretch) -> None:
    """Fill one side of a road with stretches of random kinds, most of them with a second row behind."""
    rng, kind = builder.rng, builder.kind
    makers, weights = zip(*LININGS[kind].items(), strict=True)
    share = np.array(weights) / sum(weights)
    setback = rng.uniform(0.0, 1.5 if kind == "urban" else 5.0)
    start, end = whole.start_m, whole.start_m + whole.length_m
    while start < end:
        length = min(float(rng.uniform(6.0, 24.0)), end - start)
        if not whole.cross and builder.near_junction(start, start + length):
            start += 2.0
            continue
        make = makers[int(rng.choice(len(makers), p=share))]
        away = whole.away_m + 0.3
        if make in (building, trees):
            away += max(setback + rng.normal(0, 0.7), 0.0)
        stretch = Stretch(start, length, whole.side, away, whole.cross)
        make(builder, stretch)
        if make not in (building, wood) and rng.random() < 0.92:
            behind = replace(stretch, away_m=away + rng.uniform(5.0, 16.0))
            (building if kind != "rural" and rng.random() < 0.5 else wood)(builder, behind)
        start += length + (0.0 if rng.random() < 0.6 else rng.uniform(0.5, 4.0))


def building(builder: Builder, stretch: Stretch) -> None:
    """Houses: a core with recessed windows behind pillars, plinth and lintel; steps, balconies, drainpipes."""
    rng, side, cross = builder.rng, stretch.side, stretch.cross
    depth, height = float(rng.uniform(5.0, 10.0)), float(rng.uniform(3.2, 9.0))
    recess = float(rng.uniform(0.08, 0.35))
    stone = (float(rng.uniform(0.12, 0.5)), 0.3, 0.0)
    glass = (float(rng.uniform(0.03, 0.25)), 2.0, float(rng.choice([0.0, 0.0, 0.1])))
    width = stretch.length_m / max(int(stretch.length_m // 8.0), 1)
    front, core = side * (stretch.away_m + recess / 2), side * (stretch.away_m + recess + depth / 2)
    for middle in stretch.along(width):
        if not builder.claim(middle, core, 0.9 * width, depth, cross):
            continue
        builder.box(middle, core, -1.0, (width, depth, height), glass, cross)
        plinth, lintel = float(rng.uniform(0.5, 1.2)), float(rng.uniform(2.1, 2.9))
        builder.box(middle, front, -1.0, (width, recess, plinth + 1.0), stone, cross)
        builder.box(middle, front, lintel, (width, recess, max(height - lintel - 1.0, 0.1)), stone, cross)
        step = float(rng.uniform(1.8, 3.4))
        pillar = float(rng.uniform(0.35, 0.75)) * step
        for along in np.arange(middle - width / 2 + pillar / 2, middle + width / 2, step):
            builder.box(along, front, -1.0, (pillar, recess + 0.02, height - 1.0), stone, cross)
        extra, place = rng.random(), middle + rng.uniform(-2, 2)
        size = (float(rng.uniform(1.2, 3.0)), 0.9, 0.35)
        if extra < 0.25 and builder.claim(place, side * (stretch.away_m - 0.5), *size[:2], cross):
            builder.box(place, side * (stretch.away_m - 0.5), -0.2, size, stone, cross)
        elif 0.25 < extra < 0.4:
            builder.box(place, side * (stretch.away_m - 0.45), 2.4, (size[0], 0.9, 1.0), stone, cross)
        if rng.random() < 0.5:
            pipe = middle + rng.uniform(-0.5, 0.5) * width
            builder.post(pipe, side * (stretch.away_m - 0.08), -0.1, 5.0, 0.05, 0.3, cross)


def wall(builder: Builder, stretch: Stretch) -> None:
    """A wall, sometimes with pillars."""
    rng, across, cross = builder.rng, stretch.side * stretch.away_m, stretch.cross
    height, thick = float(rng.uniform(0.5, 2.3)), float(rng.uniform(0.2, 0.4))
    stone = (float(rng.uniform(0.12, 0.45)), 0.3, 0.0)
    pillars = rng.random() < 0.4
    for along in stretch.along(4.0):
        if builder.claim(along, across, 3.6, thick, cross):
            builder.box(along, across, -0.4, (4.0, thick, height + 0.4), stone, cross)
            if pillars:
                builder.box(along + 2.0, across, -0.4, (0.4, thick + 0.12, height + 0.6), stone, cross)


def fence(builder: Builder, stretch: Stretch) -> None:
    """Boards, pickets or wire between posts: the thinner, the more rays pass."""
    rng, across, cross = builder.rng, stretch.side * stretch.away_m, stretch.cross
    height = float(rng.uniform(0.8, 2.0))
    reflectance = float(rng.uniform(0.1, 0.45))
    board = (reflectance, 0.4, float(rng.choice([0.1, 0.45, 0.75, 0.9])))
    for along in stretch.along(2.4):
        if builder.claim(along, across, 2.2, 0.05, cross):
            builder.box(along, across, 0.1, (2.4, 0.05, height - 0.1), board, cross)
            builder.box(along + 1.2, across, -0.2, (0.1, 0.1, height + 0.3), (reflectance, 0.4, 0.0), cross)


def guard_rail(builder: Builder, stretch: Stretch) -> None:
    """A steel rail on posts."""
    steel = (float(builder.rng.uniform(0.2, 0.5)), 0.8, 0.0)
    across, cross = stretch.side * (stretch.away_m - 0.2), stretch.cross
    for along in stretch.along(4.0):
        if builder.claim(along, across, 3.6, 0.1, cross):
            builder.box(along, across, 0.42, (4.0, 0.08, 0.31), steel, cross)
            builder.box(along + 2.0, across + 0.1 * stretch.side, -0.2, (0.1, 0.1, 0.9), steel, cross)


def hedge(builder: Builder, stretch: Stretch) -> None:
    """A row of dense, flat clouds."""
    rng, cross = builder.rng, stretch.cross
    height, thick = float(rng.uniform(0.7, 2.4)), float(rng.uniform(0.5, 1.2))
    green = float(rng.uniform(0.2, 0.45))
    across = stretch.side * (stretch.away_m + thick / 2)
    for along in stretch.along(1.3):
        if builder.claim(along, across, 1.2, thick, cross):
            half = height * rng.uniform(0.9, 1.1) / 2
            radii = (1.0, 0.7 * thick, 1.15 * half)
            builder.blob(along, across, 0.9 * half, radii, green, float(rng.uniform(3.0, 8.0)), cross)


def trees(builder: Builder, stretch: Stretch) -> None:
    """A row of trees with some shrubs."""
    rng = builder.rng
    for along in stretch.along(float(rng.uniform(3.5, 9.0))):
        tree(builder, along, stretch.side * (stretch.away_m + rng.uniform(0.3, 3.0)), stretch.cross)
        if rng.random() < 0.6:
            place = stretch.side * (stretch.away_m + rng.uniform(0.2, 4.0))
            shrub(builder, along + rng.normal(0, 2.0), place, stretch.cross)


def wood(builder: Builder, stretch: Stretch) -> None:
    """A dense edge of trees and undergrowth, as it closes most views in KITTI."""
    rng = builder.rng
    for along in stretch.along(1.7):
        shrub(builder, along, stretch.side * (stretch.away_m + rng.uniform(0.0, 2.5)), stretch.cross, tall=True)
        if rng.random() < 0.4:
            tree(builder, along, stretch.side * (stretch.away_m + rng.uniform(1.0, 8.0)), stretch.cross)


def lawn(builder: Builder, stretch: Stretch) -> None:
    """Open ground, perhaps with one tree."""
    if builder.rng.random() < 0.5:
        away = stretch.away_m + builder.rng.uniform(1.0, 8.0)
        tree(builder, stretch.middle_m, stretch.side * away, stretch.cross)


def tree(builder: Builder, along: float, across: float, cross: bool = False) -> None:
    """A trunk and a crown."""
    rng = builder.rng
    radius = float(rng.uniform(0.07, 0.32))
    if not builder.claim(along, across, 2 * radius, 2 * radius, cross):
        return
    trunk, crown = float(rng.uniform(1.2, 3.5)), float(rng.uniform(1.0, 3.0))
    builder.post(along, across, -0.3, trunk + 2.0, 1.15 * radius, float(rng.uniform(0.1, 0.4)), cross, taper=0.6)
    density = float(np.exp(rng.uniform(*np.log(builder.config.crown_density_per_m))))
    builder.foliage(along, across, trunk + 0.9 * crown, crown, int(rng.integers(6, 13)), density, cross)


def shrub(builder: Builder, along: float, across: float, cross: bool = False, tall: bool = False) -> None:
    """A bush from the ground up; low ones are often the size of a person."""
    rng = builder.rng
    size = rng.uniform(0.6, 1.8, 2) if tall else rng.uniform(0.3, 1.0, 2)
    height = float(rng.uniform(1.0, 2.6) if tall else rng.uniform(0.25, 1.0))
    if builder.claim(along, across, float(size[0]), float(size[1]), cross):
        density = float(np.exp(rng.uniform(np.log(0.4), np.log(3.5))))
        radius = 0.9 * max(height, float(size.max()))
        builder.foliage(along, across, 0.5 * height, radius, int(rng.integers(3, 7)), density, cross)


# What stands beside a kind of street, by share.
LININGS: dict[str, dict[Callable[[Builder, Stretch], None], float]] = {
    "residential": {building: 0.33, hedge: 0.17, wall: 0.14, fence: 0.12, trees: 0.16, lawn: 0.08},
    "urban": {building: 0.58, wall: 0.10, fence: 0.08, trees: 0.16, lawn: 0.08},
    "rural": {trees: 0.24, wood: 0.30, hedge: 0.12, fence: 0.08, guard_rail: 0.12, lawn: 0.08, building: 0.06},
    "campus": {building: 0.40, trees: 0.25, hedge: 0.12, lawn: 0.15, wall: 0.08},
}
