"""Trees, hedges, shrubs and woods: clusters of leaves with gaps between them, which rays penetrate."""

import math

import numpy as np

from asca_pillars.geometry.boxes import Floats
from asca_pillars.sim.world.builder import Builder, Stretch

# Far clusters are larger and fewer, as rays cannot resolve them.
FINEST, FINE_WITHIN_M, COARSER_PER_M = 0.75, 8.0, 0.033


def coarseness(builder: Builder, along: float, across: float, cross: bool) -> float:
    """Return the factor on the size of leaf clusters at a position, relative to those some 17 m away."""
    x, y, _ = builder.to_lidar(along, across, cross)
    return FINEST + COARSER_PER_M * max(math.hypot(x, y) - FINE_WITHIN_M, 0.0)


def hedge(builder: Builder, stretch: Stretch) -> None:
    """Add a trimmed hedge, sometimes with gaps or only of a car's length."""
    rng, cross = builder.rng, stretch.cross
    height, thick = float(rng.uniform(0.7, 2.8)), float(rng.uniform(0.5, 1.4))
    across = stretch.side * (stretch.away_m + thick / 2)
    gaps = 0.0 if rng.random() < 0.6 else 0.2
    starts = [a for a in stretch.along(2.4) if rng.random() >= gaps and builder.reserve(a, across, 2.3, thick, cross)]
    if not starts:
        return
    step = 0.55 * coarseness(builder, stretch.middle_m, across, cross)
    along = (np.array(starts)[:, None] + np.arange(-1.2 + step / 2, 1.2, step)).ravel()
    _leaves_of_hedge(builder, along, across, (step, thick, height), cross)


def hedge_block(builder: Builder, along: float, across: float) -> None:
    """Add a hedge cut to a block, as large as a car or a person."""
    rng = builder.rng
    length, width, height = rng.uniform(0.6, 4.5), rng.uniform(0.5, 1.8), rng.uniform(0.6, 2.0)
    if builder.reserve(along, across, float(length), float(width)):
        places = along + np.arange(-length / 2 + 0.3, length / 2 - 0.2, 0.5)
        _leaves_of_hedge(builder, places, across, (0.5, float(width), float(height)), cross=False)


def _leaves_of_hedge(
    builder: Builder, along: Floats, across: float, size: tuple[float, float, float], cross: bool
) -> None:
    rng, (step, thick, height) = builder.rng, size
    rows = max(int(height / 0.7), 1)
    along = np.repeat(along, rows) + rng.normal(0.0, 0.08, len(along) * rows)
    count = len(along)
    level = np.tile((np.arange(rows) + 0.5) * height / rows, count // rows)
    radii = np.stack(
        [
            step * rng.uniform(0.7, 1.2, count),
            thick * rng.uniform(0.42, 0.62, count),
            height / rows * rng.uniform(0.5, 0.75, count),
        ],
        axis=-1,
    )
    z = np.maximum(level + rng.normal(0.0, 0.05, count), 0.6 * radii[:, 2])
    density = rng.uniform(2.5, 7.0) * np.exp(rng.normal(0.0, 0.4, count))
    sideways = np.full(count, across) + rng.normal(0.0, 0.07, count)
    builder.clouds(along, sideways, z, radii, rng.uniform(0.2, 0.45), density, cross, turned=False)


def wood(builder: Builder, stretch: Stretch) -> None:
    """Add the dense edge of a wood or an overgrown slope, as in most views in KITTI; with trunks in front of it."""
    rng, side, cross = builder.rng, stretch.side, stretch.cross
    front = side * (stretch.away_m + 1.0)
    free = np.array([a for a in stretch.along(3.0) if builder.reserve(a, front, 2.9, 1.8, cross)])
    if not len(free):
        return
    coarse = coarseness(builder, stretch.middle_m, front, cross)
    # Far woods matter only as far as they are higher than objects before them.
    height = float(rng.uniform(2.6, 5.0)) + 1.2 * max(coarse - 1.0, 0.0)
    density = float(np.exp(rng.uniform(np.log(1.5), np.log(6.0))))
    radius = 0.36 * coarse
    count = max(int(len(free) * 3.0 * height * 0.45 / radius**2), 3)
    along = rng.choice(free, count) + rng.uniform(-1.5, 1.5, count)
    waves = 0.6 * np.sin(along * rng.uniform(0.3, 1.2) + rng.uniform(0.0, 6.0))
    away = stretch.away_m + 0.7 + waves + np.abs(rng.normal(0.0, 0.6, count))
    _clusters(builder, along, side * away, rng.uniform(0.1, height, count), radius, density, cross)
    # Rays that come through hit the inside of the wood.
    deep = max(count // 6, 2)
    along = rng.choice(free, deep) + rng.uniform(-1.5, 1.5, deep)
    away = stretch.away_m + rng.uniform(2.0, 5.0, deep)
    _clusters(builder, along, side * away, rng.uniform(0.3, height, deep), 2.2 * radius, 0.5 * density, cross)
    if rng.random() < 0.6:
        for place in stretch.along(float(rng.uniform(4.0, 9.0))):
            trunk(builder, place + rng.normal(0, 1.0), side * (stretch.away_m + rng.uniform(-1.0, 1.0)), 6.0, cross)


def overgrow(builder: Builder, stretch: Stretch) -> None:
    """Add patches of ivy and shrubs before, on and behind the lining of a section, as on most fences in KITTI."""
    rng, side, cross = builder.rng, stretch.side, stretch.cross
    radius = 0.26 * coarseness(builder, stretch.middle_m, side * stretch.away_m, cross)
    for _ in range(1 + int(stretch.length_m / 8.0)):
        middle, long = stretch.start_m + rng.uniform(0.0, stretch.length_m), rng.uniform(0.4, 3.0)
        height, deep = rng.uniform(0.5, 3.0), rng.uniform(0.15, 0.7)
        if not builder.reserve(float(middle), side * (stretch.away_m - deep), 2 * long, deep, cross):
            continue
        count = max(int(2 * long * height * 0.5 / radius**2), 3)
        # Thinner upward and towards its ends.
        along = middle + long * rng.normal(0.0, 0.5, count)
        away = stretch.away_m - deep * np.abs(rng.normal(0.0, 0.5, count)) + rng.uniform(0.0, 0.4, count)
        z = height * rng.random(count) ** 1.3
        _clusters(builder, along, side * away, z, radius, float(rng.uniform(2.0, 8.0)), cross)


def wood_across(builder: Builder, along: float, half_width: float) -> None:
    """Add a wood's edge across the road's direction, at its end."""
    rng = builder.rng
    places = np.arange(-half_width, half_width, 3.0)
    free = np.array([v for v in places if builder.reserve(along, float(v), 1.8, 2.9)])
    if not len(free):
        return
    radius = 0.4 * coarseness(builder, along, 0.0, cross=False)
    count = max(int(len(free) * 3.0 * 5.0 * 0.45 / radius**2), 3)
    across = rng.choice(free, count) + rng.uniform(-1.5, 1.5, count)
    deep = along + np.sign(along) * np.abs(rng.normal(0.0, 0.8, count))
    _clusters(builder, deep, across, rng.uniform(0.1, 5.0, count), radius, float(rng.uniform(1.5, 6.0)), cross=False)


def _clusters(
    builder: Builder, along: Floats, across: Floats, z: Floats, radius: float, density: float, cross: bool
) -> None:
    rng, count = builder.rng, len(along)
    radii = radius * np.exp(rng.normal(0.0, 0.35, (count, 1))) * rng.uniform(0.7, 1.3, (count, 3))
    densities = density * np.exp(rng.normal(0.0, 0.6, count))
    builder.clouds(along, across, np.maximum(z, 0.3 * radii[:, 2]), radii, rng.uniform(0.2, 0.5), densities, cross)


def crown(
    builder: Builder, along: float, across: float, z: float, size: tuple[float, float], density: float, cross: bool
) -> None:
    """Add clusters of leaves about a middle z above the ground, within `size` (radius across, radius up)."""
    rng, (wide, tall) = builder.rng, size
    coarse = coarseness(builder, along, across, cross)
    count = max(int(rng.integers(20, 50) / coarse), 3)
    way = rng.normal(0.0, 1.0, (count, 3))
    # Leaves grow towards the light: more of them outside than in the center.
    way *= rng.uniform(0.3, 1.0, (count, 1)) ** 0.5 / np.linalg.norm(way, axis=1, keepdims=True)
    radius = 0.23 * (wide + tall) / 2 * coarse**0.5
    up = z + tall * way[:, 2]
    _clusters(builder, along + wide * way[:, 0], across + wide * way[:, 1], up, radius, density, cross)


def trees(builder: Builder, stretch: Stretch) -> None:
    """Add a row of trees of similar height, with some shrubs."""
    rng = builder.rng
    away, tall = stretch.away_m + rng.uniform(0.3, 2.0), float(rng.uniform(1.0, 5.0))
    for along in stretch.along(float(rng.uniform(3.5, 10.0))):
        tree(builder, along, stretch.side * (away + rng.normal(0.0, 0.3)), stretch.cross, tall)
        if rng.random() < 0.5:
            place = stretch.side * (stretch.away_m + rng.uniform(0.2, 4.0))
            shrub(builder, along + rng.normal(0, 2.0), place, stretch.cross)


def tree(builder: Builder, along: float, across: float, cross: bool = False, tall_m: float | None = None) -> None:
    """Add a trunk, mostly without branches up to the height of a laser, and a crown."""
    rng = builder.rng
    base = (float(rng.uniform(1.0, 5.0)) if tall_m is None else tall_m) * float(rng.uniform(0.85, 1.15))
    if not trunk(builder, along, across, base + 1.5, cross):
        return
    wide = float(rng.uniform(0.9, 2.8))
    tall = wide * float(rng.uniform(0.7, 1.5))
    density = float(np.exp(rng.uniform(*np.log(builder.config.crown_density_per_m))))
    crown(builder, along, across, base + 0.8 * tall, (wide, tall), density, cross)


def trunk(builder: Builder, along: float, across: float, height: float, cross: bool = False) -> bool:
    """Add a straight or leaning trunk of one to three stems; return whether there was room for it."""
    rng = builder.rng
    thick = rng.random() < builder.config.thick_trunks
    radius = float(rng.uniform(0.175, 0.30) if thick else np.exp(rng.uniform(np.log(0.06), np.log(0.40))))
    if not builder.reserve(along, across, 2.4 * radius, 2.4 * radius, cross):
        return False
    boles = 1 if thick else int(rng.choice([1, 1, 1, 2, 3]))
    bark = float(rng.uniform(0.1, 0.4))
    if thick:
        flare, tall = radius * float(rng.uniform(1.3, 2.2)), float(rng.uniform(0.3, 0.9))
        builder.post(along, across, -0.1, tall, flare, bark, cross, taper=radius / flare)
        if rng.random() < 0.4:  # a low kerb round its bed
            wide = float(rng.uniform(0.8, 1.8))
            builder.box(along, across, -0.2, (wide, wide, 0.2 + float(rng.uniform(0.04, 0.16))), (0.3, 0.3, 0.0), cross)
    if rng.random() < 0.3:  # ivy or shoots round its foot
        round_it = (radius + float(rng.uniform(0.1, 0.3)), float(rng.uniform(0.4, 0.9)))
        crown(builder, along, across, 0.9 * round_it[1], round_it, float(rng.uniform(3.0, 8.0)), cross)
    for _ in range(boles):
        lean = rng.normal(0.0, 0.05 if boles == 1 and rng.random() < 0.8 else 0.16, 2)
        builder.post(
            along,
            across,
            -0.3,
            height + 0.3,
            radius * (1.15 if boles == 1 else 0.7),
            bark,
            cross,
            taper=0.6,
            lean=(float(lean[0]), float(lean[1])),
        )
    return True


def shrub(builder: Builder, along: float, across: float, cross: bool = False, tall: bool = False) -> None:
    """Add a bush from the ground up: round, or a column the size of a person."""
    rng = builder.rng
    column = rng.random() < 0.25
    if column:
        wide, height = float(rng.uniform(0.2, 0.5)), float(rng.uniform(1.0, 2.4))
    else:
        wide = float(rng.uniform(0.4, 1.2) if tall else rng.uniform(0.2, 0.7))
        height = float(rng.uniform(1.0, 3.0) if tall else rng.uniform(0.3, 1.4))
    if builder.reserve(along, across, 1.6 * wide, 1.6 * wide, cross):
        density = float(np.exp(rng.uniform(np.log(1.0), np.log(8.0))))
        crown(builder, along, across, 0.5 * height, (0.8 * wide, 0.45 * height), density, cross)


def weeds(builder: Builder, along: float, across: float) -> None:
    """Add tufts of grass, weeds and leaves, knee-high at most, along a kerb or anywhere."""
    rng = builder.rng
    long, wide = float(rng.uniform(0.3, 4.0)), float(rng.uniform(0.2, 0.9))
    if builder.reserve(along, across, long, wide):
        count = 2 + int(4.0 * long * wide**0.5)
        radii = rng.uniform(0.08, 0.28, (count, 1)) * rng.uniform(0.7, 1.4, (count, 3))
        places = along + long * rng.uniform(-0.5, 0.5, count), across + wide * rng.uniform(-0.5, 0.5, count)
        z = rng.uniform(0.02, 0.45, count) * rng.random(count)
        builder.clouds(*places, z, radii, rng.uniform(0.2, 0.5), np.exp(rng.uniform(0.7, 2.7, count)))


def bush(builder: Builder, along: float, across: float) -> None:
    """Add a bush or a clump of them as large as a car, broad at the bottom or at the top."""
    rng = builder.rng
    long, wide, height = float(rng.uniform(0.7, 2.3)), float(rng.uniform(0.6, 1.3)), float(rng.uniform(0.9, 2.6))
    if not builder.reserve(along, across, 1.8 * long, 1.8 * wide):
        return
    count = int(30 * long * wide * height**0.5)
    up = rng.random(count)
    shape = float(rng.uniform(-0.7, 0.7))  # width of its top relative to its bottom
    spread = np.sqrt(rng.random(count)) * np.clip(1.0 + shape * (up - 0.5), 0.2, 1.5)
    way = rng.uniform(0.0, 2 * np.pi, count)
    places = along + 0.85 * long * spread * np.cos(way), across + 0.85 * wide * spread * np.sin(way)
    _clusters(builder, *places, 0.1 + height * up, 0.2, float(rng.uniform(2.0, 7.0)), cross=False)
