"""Linings of the streets on both sides: houses, walls, fences, guard rails, and the distant background."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from asca_pillars.sim.world.builder import Builder, Material, Stretch
from asca_pillars.sim.world.vegetation import hedge, overgrow, tree, trees, wood, wood_across


def wall(builder: Builder, stretch: Stretch) -> None:
    """Add a wall, sometimes with pillars, sometimes in steps along the slope."""
    rng = builder.rng
    _wall(builder, stretch, float(rng.uniform(0.3, 2.4)), pillars=bool(rng.random() < 0.4))


def high_wall(builder: Builder, stretch: Stretch) -> None:
    """Add a wall above eye level: a noise barrier, of a yard, of an underpass."""
    _wall(builder, stretch, float(builder.rng.uniform(2.4, 5.0)), pillars=bool(builder.rng.random() < 0.3))


def _wall(builder: Builder, stretch: Stretch, height: float, pillars: bool) -> None:
    rng, across, cross = builder.rng, stretch.side * stretch.away_m, stretch.cross
    thick = float(rng.uniform(0.15, 0.4))
    stone = (float(rng.uniform(0.2, 0.55)), 0.3, 0.0)
    uneven = float(rng.choice([0.0, 0.0, 0.15]))
    for along in stretch.along(4.0):
        if builder.reserve(along, across, 3.6, thick, cross):
            top = height + uneven * float(rng.normal())
            builder.box(along, across, -0.6, (4.0, thick, max(top, 0.2) + 0.6), stone, cross)
            if pillars:
                builder.box(along + 2.0, across, -0.6, (0.4, thick + 0.15, height + 0.8), stone, cross)


def fence(builder: Builder, stretch: Stretch) -> None:
    """Add boards, pickets or wire between posts: the thinner, the more rays pass."""
    rng, across, cross = builder.rng, stretch.side * stretch.away_m, stretch.cross
    height, step = float(rng.uniform(0.8, 2.2)), float(rng.uniform(2.0, 3.5))
    reflectance = float(rng.uniform(0.15, 0.55))
    board = (reflectance, 0.4, float(rng.choice([0.0, 0.3, 0.6, 0.8, 0.93])))
    for along in stretch.along(step):
        if builder.reserve(along, across, step - 0.2, 0.05, cross):
            builder.box(along, across, 0.08, (step, 0.04, height - 0.1), board, cross)
            builder.box(along + step / 2, across, -0.3, (0.09, 0.09, height + 0.35), (reflectance, 0.4, 0.0), cross)


def railing(builder: Builder, stretch: Stretch) -> None:
    """Add a low wall with bars on it between pillars, often with a hedge behind."""
    rng, side, cross = builder.rng, stretch.side, stretch.cross
    across = side * stretch.away_m
    base, top, thick = float(rng.uniform(0.15, 0.9)), float(rng.uniform(0.9, 1.7)), float(rng.uniform(0.15, 0.35))
    stone: Material = (float(rng.uniform(0.15, 0.45)), 0.3, 0.0)
    iron: Material = (float(rng.uniform(0.08, 0.35)), 0.5, 0.0)
    bars: Material = (iron[0], 0.5, float(rng.uniform(0.4, 0.85)))
    step = float(rng.uniform(2.0, 4.0))
    for along in stretch.along(step):
        if builder.reserve(along, across, step - 0.3, thick, cross):
            builder.box(along, across, -0.5, (step, thick, base + 0.5), stone, cross)
            builder.box(along, across, base, (step, 0.03, max(top - base, 0.1)), bars, cross)
            builder.box(along, across, top - 0.04, (step, 0.05, 0.06), iron, cross)
            builder.box(along + step / 2, across, -0.5, (0.35, thick + 0.1, top + 0.6), stone, cross)
    if rng.random() < 0.5:
        hedge(builder, Stretch(stretch.start_m, stretch.length_m, side, stretch.away_m + 0.4, cross))


def bars(builder: Builder, stretch: Stretch) -> None:
    """Add a pedestrian railing: posts and two or three level tubes."""
    rng, across, cross = builder.rng, stretch.side * stretch.away_m, stretch.cross
    height, step = float(rng.uniform(0.7, 1.2)), float(rng.uniform(1.5, 2.5))
    steel: Material = (float(rng.uniform(0.15, 0.5)), 0.5, 0.0)
    levels = int(rng.integers(1, 4))
    for along in stretch.along(step):
        if builder.reserve(along, across, step - 0.1, 0.05, cross):
            builder.post(along - step / 2, across, -0.2, height + 0.2, 0.03, steel[0], cross)
            for level in range(levels):
                builder.box(along, across, height * (level + 1) / levels - 0.05, (step, 0.05, 0.05), steel, cross)


def guard_rail(builder: Builder, stretch: Stretch) -> None:
    """Add a steel rail on posts, single or on both sides of them."""
    rng = builder.rng
    steel: Material = (float(rng.uniform(0.2, 0.5)), 0.8, 0.0)
    across, cross = stretch.side * stretch.away_m, stretch.cross
    double, low = bool(rng.random() < 0.3), float(rng.uniform(0.35, 0.5))
    for along in stretch.along(4.0):
        if builder.reserve(along, across, 3.6, 0.1, cross):
            builder.box(along, across, low, (4.0, 0.08, 0.31), steel, cross)
            if double:
                builder.box(along, across + 0.4 * stretch.side, low, (4.0, 0.08, 0.31), steel, cross)
            for post in (along, along + 2.0):
                builder.box(post, across + 0.15 * stretch.side, -0.2, (0.1, 0.1, low + 0.5), steel, cross)


def concrete_barrier(builder: Builder, stretch: Stretch) -> None:
    """Add blocks with a broad foot, as beside trunk roads and works."""
    rng, across, cross = builder.rng, stretch.side * stretch.away_m, stretch.cross
    stone: Material = (float(rng.uniform(0.2, 0.45)), 0.3, 0.0)
    height = float(rng.uniform(0.75, 1.1))
    for along in stretch.along(3.0):
        if builder.reserve(along, across, 2.9, 0.6, cross):
            builder.box(along, across, -0.2, (2.95, 0.6, 0.4), stone, cross)
            builder.box(along, across, 0.2, (2.95, 0.25, height - 0.2), stone, cross)


def building(builder: Builder, stretch: Stretch) -> None:
    """Add houses side by side, some slightly forward or back, some with a passage between them."""
    rng = builder.rng
    depth, height = float(rng.uniform(5.0, 10.0)), float(rng.uniform(3.2, 9.0))
    width = stretch.length_m / max(int(stretch.length_m // 8.0), 1)
    uneven = float(rng.choice([0.0, 0.0, 0.4, 1.2]))
    for middle in stretch.along(width):
        away = stretch.away_m + uneven * rng.random()
        passage = 0.0 if rng.random() < 0.7 else float(rng.uniform(0.8, 3.0))
        if builder.reserve(middle, stretch.side * (away + 0.2 + depth / 2), 0.9 * width, depth, stretch.cross):
            _house(builder, middle, stretch.side, away, (width - passage, depth, height), stretch.cross)


def _house(
    builder: Builder, middle: float, side: float, away: float, size: tuple[float, float, float], cross: bool
) -> None:
    """Add a core with recessed windows behind pillars, plinth and lintel; steps, balconies, awnings, drainpipes."""
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
        if builder.reserve(place, side * (away - 0.15 * steps), long, 0.3 * steps, cross):
            for i in range(steps):
                deep = 0.3 * (steps - i)
                builder.box(place, side * (away - deep / 2), -0.3, (long, deep, 0.3 + 0.17 * (i + 1)), stone, cross)
    elif extra < 0.4:  # balcony
        builder.box(place, side * (away - 0.5), 2.3, (long, 1.0, 1.1), stone, cross)
    elif extra < 0.5:  # awning
        builder.box(place, side * (away - 0.7), 2.2, (1.5 * long, 1.4, 0.12), (0.4, 0.3, 0.0), cross)
    elif extra < 0.62 and builder.reserve(place, side * (away - 0.35), long, 0.7, cross):  # bay window
        builder.box(place, side * (away - 0.35), -0.5, (long, 0.7, 4.0), stone, cross)
    elif extra < 0.7 and builder.reserve(place, side * (away - 0.6), 0.2, 0.2, cross):  # porch
        builder.post(place, side * (away - 0.7), -0.2, 2.6, 0.07, stone[0], cross)
        builder.box(place, side * (away - 0.5), 2.3, (2.0, 1.2, 0.2), stone, cross)


def close_view(builder: Builder, along: float, half_width: float) -> None:
    """Close the end of a street with a wood or a house."""
    rng = builder.rng
    if rng.random() < 0.6:
        wood_across(builder, along, half_width)
        return
    stone: Material = (float(rng.uniform(0.2, 0.6)), 0.3, 0.0)
    glass: Material = (float(rng.uniform(0.03, 0.25)), 2.0, 0.0)
    wide, toward = float(rng.uniform(9.0, 20.0)), -1.0 if along > 0 else 1.0
    middle = float(rng.normal(0.0, 3.0))
    if builder.reserve(along, middle, 6.0, wide):
        builder.box(along, middle, -1.5, (6.0, wide, 9.0), glass)
        front = along + 3.1 * toward
        builder.box(front, middle, -1.5, (0.2, wide, 2.3), stone)
        builder.box(front, middle, 2.4, (0.2, wide, 5.0), stone)
        for across in np.arange(middle - wide / 2 + 0.5, middle + wide / 2, float(rng.uniform(1.8, 3.2))):
            builder.box(front, across, -1.5, (0.22, 1.0, 7.0), stone)


def garages(builder: Builder, stretch: Stretch) -> None:
    """Add flat boxes with recessed gates, some of them open, set back from the street."""
    rng, side, cross = builder.rng, stretch.side, stretch.cross
    height, depth = float(rng.uniform(2.1, 2.7)), float(rng.uniform(4.5, 6.5))
    stone: Material = (float(rng.uniform(0.2, 0.6)), 0.3, 0.0)
    gate: Material = (float(rng.uniform(0.1, 0.4)), 0.5, 0.0)
    away = stretch.away_m + float(rng.choice([0.0, 2.0, 5.0]))
    for along in stretch.along(3.0):
        if not builder.reserve(along, side * (away + depth / 2), 2.9, depth, cross):
            continue
        recess = float(rng.uniform(0.1, 0.5)) if rng.random() < 0.85 else depth - 0.4
        builder.box(
            along, side * (away + recess + (depth - recess) / 2), -0.5, (3.0, depth - recess, height), gate, cross
        )
        builder.box(along, side * (away + depth / 2), height - 0.35, (3.0, depth, 0.35), stone, cross)
        for edge in (-1.4, 1.4):
            builder.box(along + edge, side * (away + depth / 2), -0.5, (0.3, depth, height + 0.4), stone, cross)


def open_roof(builder: Builder, stretch: Stretch) -> None:
    """Add a carport, a pergola, a petrol station: a roof on posts."""
    rng, side, cross = builder.rng, stretch.side, stretch.cross
    deep, height = float(rng.uniform(2.5, 6.0)), float(rng.uniform(2.0, 3.5))
    beam: Material = (float(rng.uniform(0.15, 0.5)), 0.3, float(rng.choice([0.0, 0.5])))
    radius = float(rng.uniform(0.04, 0.15))
    for along in stretch.along(float(rng.uniform(2.0, 4.0))):
        for away in (0.1, deep - 0.1):
            if builder.reserve(along, side * (stretch.away_m + away), 2 * radius, 2 * radius, cross):
                builder.post(along, side * (stretch.away_m + away), -0.2, height + 0.2, radius, beam[0], cross)
    middle = side * (stretch.away_m + deep / 2)
    builder.box(stretch.middle_m, middle, height, (stretch.length_m, deep, 0.2), beam, cross)


def scaffolding(builder: Builder, stretch: Stretch) -> None:
    """Add thin tubes and planks before a wall."""
    rng, side, cross = builder.rng, stretch.side, stretch.cross
    wood: Material = (float(rng.uniform(0.22, 0.6)), 0.3, 0.0)
    net: Material = (0.25, 0.3, float(rng.choice([0.6, 0.9, 1.0])))
    building(builder, Stretch(stretch.start_m, stretch.length_m, side, stretch.away_m + 1.3, cross))
    for along in stretch.along(2.2):
        for away in (0.0, 0.8):
            if builder.reserve(along, side * (stretch.away_m + away), 0.08, 0.08, cross):
                builder.post(along, side * (stretch.away_m + away), -0.1, 6.0, 0.03, 0.4, cross)
        for level in (0.15, 2.1):
            builder.box(along, side * (stretch.away_m + 0.4), level, (2.2, 0.7, 0.05), wood, cross)
            builder.box(along, side * stretch.away_m, level + 0.95, (2.2, 0.04, 0.06), wood, cross)
        builder.box(along, side * (stretch.away_m - 0.03), 0.2, (2.2, 0.01, 5.0), net, cross)


Lining = Callable[[Builder, Stretch], None]
OVERGROWN_SHARE = {"residential": 0.45, "urban": 0.25, "rural": 0.4, "campus": 0.35, "road": 0.4, "alley": 0.45}
AVENUE_SHARE = {"residential": 0.2, "urban": 0.35, "rural": 0.15, "campus": 0.3, "road": 0.15, "alley": 0.0}


def line_streets(builder: Builder) -> None:
    """Add both sides of both roads, the strip between two carriageways, and distant houses and woods."""
    ground = builder.ground
    half, pavement = ground.half_width_m, ground.pavement_m
    for side in (1.0, -1.0):
        edge = (ground.left_edge_m if side > 0 else half) + pavement
        _line(builder, Stretch(-85.0, 170.0, side, edge))
        if ground.cross_half_m > 0:
            beyond = edge + 5.0
            across = ground.cross_half_m + pavement
            _line(builder, Stretch(beyond, 70.0 - beyond, side, across, cross=True))
            _line(builder, Stretch(-70.0, 70.0 - beyond, side, across, cross=True))
        _backdrop(builder, side, edge)
        if builder.rng.random() < AVENUE_SHARE[builder.kind]:
            _avenue(builder, side)
    if ground.left_edge_m > half:
        _part_carriageways(builder)
    for way in (1.0, -1.0):
        if builder.rng.random() < builder.config.closed_end_share:
            end = float(builder.rng.uniform(18.0 if builder.kind == "campus" else 35.0, 85.0))
            close_view(builder, way * end, half + pavement + 12.0)


def _line(builder: Builder, whole: Stretch) -> None:
    """Fill one side of a road with stretches of random kinds, most of them with a second row behind."""
    rng, kind = builder.rng, builder.kind
    makers, weights = zip(*LININGS[kind].items(), strict=True)
    share = np.array(weights) / sum(weights)
    setback = float(rng.uniform(0.0, {"urban": 1.5, "alley": 0.5}.get(kind, 4.5)))
    if kind in ("road", "rural") and rng.random() < 0.5:
        _everywhere(builder, guard_rail, replace(whole, away_m=whole.away_m - 0.2))
    # Some streets have one lining throughout; on others it changes between neighbors.
    longest = float(rng.choice([16.0, 30.0, 60.0]))
    start, end = whole.start_m, whole.start_m + whole.length_m
    while start < end:
        length = min(float(rng.uniform(6.0, longest)), end - start)
        if not whole.cross and builder.near_junction(start, start + min(length, 6.0)):
            start += 2.0
            continue
        if not whole.cross:
            length = builder.until_junction(start, length)
        make = makers[int(rng.choice(len(makers), p=share))]
        away = whole.away_m + 0.3
        if make in (building, trees, wood):
            away += max(setback + rng.normal(0, 0.7), 0.0)
        stretch = Stretch(start, length, whole.side, away, whole.cross)
        make(builder, stretch)
        if make not in (wood, lawn, trees) and rng.random() < OVERGROWN_SHARE[kind]:
            overgrow(builder, stretch)
        if make not in (building, wood, high_wall) and rng.random() < 0.95:
            behind = replace(stretch, away_m=away + rng.uniform(2.0, 10.0))
            (building if kind not in ("rural", "road") and rng.random() < 0.5 else wood)(builder, behind)
        start += length + (0.0 if rng.random() < 0.7 else rng.uniform(0.5, 4.0))


def _everywhere(builder: Builder, make: Lining, whole: Stretch) -> None:
    """Add one lining along a whole side, open at a junction only."""
    if whole.cross:
        make(builder, whole)
        return
    start, end = whole.start_m, whole.start_m + whole.length_m
    while start < end:
        length = builder.until_junction(start, end - start)
        if length > 1.0 and not builder.near_junction(start, start + 1.0):
            make(builder, replace(whole, start_m=start, length_m=length))
        start += max(length, 2.0)


def _part_carriageways(builder: Builder) -> None:
    """Add rails, hedges, trees or nothing on the strip between two carriageways."""
    rng, ground = builder.rng, builder.ground
    makers: tuple[Lining, ...] = (guard_rail, guard_rail, concrete_barrier, hedge, trees, bars, lawn)
    make = makers[int(rng.integers(len(makers)))]
    if ground.rails_v_m is not None and make in (trees, hedge):  # a bed of tracks leaves no room for them
        make = bars
    _everywhere(builder, make, Stretch(-85.0, 170.0, 1.0, ground.half_width_m + rng.uniform(0.3, 0.6)))


def _backdrop(builder: Builder, side: float, edge: float) -> None:
    """Add houses and woods behind the second row, with some gaps: few views in a valley extend to the horizon."""
    rng = builder.rng
    away, share = float(rng.uniform(14.0, 40.0)), float(rng.uniform(0.55, 1.0))
    start = -85.0
    while start < 85.0:
        length = float(rng.uniform(10.0, 30.0))
        stretch = Stretch(start, length, side, edge + away + float(rng.normal(0.0, 2.0)))
        if rng.random() < share and not builder.near_junction(start, start + length):
            (building if rng.random() < 0.4 else wood)(builder, stretch)
        start += length
        if rng.random() < 0.3:
            away = float(rng.uniform(14.0, 40.0))


def _avenue(builder: Builder, side: float) -> None:
    """Add trees right behind the kerb, whose crowns begin above most lasers."""
    rng, half = builder.rng, builder.ground.half_width_m
    step, tall = float(rng.uniform(5.0, 14.0)), float(rng.uniform(2.2, 5.0))
    across = side * (half + float(rng.uniform(0.4, max(0.8, 0.5 * builder.ground.pavement_m))))
    for along in np.arange(-80.0, 80.0, step):
        if rng.random() < 0.85 and not builder.near_junction(along, along):
            tree(builder, float(along + rng.normal(0, 0.3)), float(across + rng.normal(0, 0.1)), tall_m=tall)


def lawn(builder: Builder, stretch: Stretch) -> None:
    """Add open ground, perhaps with one tree."""
    if builder.rng.random() < 0.5:
        away = stretch.away_m + builder.rng.uniform(0.3, 8.0)
        tree(builder, stretch.middle_m, stretch.side * away, stretch.cross)


# Shares of the linings of each kind of street.
LININGS: dict[str, dict[Lining, float]] = {
    "residential": {
        building: 0.28,
        hedge: 0.17,
        wall: 0.09,
        railing: 0.10,
        fence: 0.08,
        garages: 0.06,
        trees: 0.10,
        wood: 0.05,
        lawn: 0.04,
        open_roof: 0.02,
        scaffolding: 0.01,
    },
    "urban": {
        building: 0.53,
        wall: 0.06,
        fence: 0.05,
        railing: 0.06,
        bars: 0.04,
        trees: 0.13,
        hedge: 0.06,
        lawn: 0.03,
        scaffolding: 0.02,
        open_roof: 0.02,
    },
    "rural": {wood: 0.42, trees: 0.16, hedge: 0.15, fence: 0.07, lawn: 0.10, building: 0.06, wall: 0.04},
    "campus": {
        building: 0.34,
        trees: 0.22,
        hedge: 0.15,
        lawn: 0.10,
        wall: 0.07,
        bars: 0.04,
        open_roof: 0.04,
        railing: 0.04,
    },
    "road": {wood: 0.45, high_wall: 0.12, trees: 0.13, hedge: 0.10, lawn: 0.08, concrete_barrier: 0.06, fence: 0.06},
    "alley": {wall: 0.14, high_wall: 0.14, hedge: 0.16, fence: 0.13, garages: 0.14, building: 0.22, railing: 0.07},
}
