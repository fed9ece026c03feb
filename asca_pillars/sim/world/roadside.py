"""What lines the streets on both sides, and what closes the view far behind."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from asca_pillars.sim.world.barriers import bars, concrete_barrier, fence, guard_rail, high_wall, railing, wall
from asca_pillars.sim.world.builder import Builder, Stretch
from asca_pillars.sim.world.facades import building, close_view, garages, open_roof, scaffolding
from asca_pillars.sim.world.vegetation import hedge, overgrow, tree, trees, wood

Lining = Callable[[Builder, Stretch], None]
OVERGROWN_SHARE = {"residential": 0.45, "urban": 0.25, "rural": 0.4, "campus": 0.35, "road": 0.4, "alley": 0.45}
AVENUE_SHARE = {"residential": 0.2, "urban": 0.35, "rural": 0.15, "campus": 0.3, "road": 0.15, "alley": 0.0}


def line_streets(builder: Builder) -> None:
    """Both sides of both roads, the strip between two carriageways, and houses and woods far behind them."""
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
    # On some streets one thing goes on and on; on others every neighbor has chosen otherwise.
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
    """One lining along a whole side, open at a junction only."""
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
    """Rails, hedges, trees or nothing on the strip between two carriageways."""
    rng, ground = builder.rng, builder.ground
    makers: tuple[Lining, ...] = (guard_rail, guard_rail, concrete_barrier, hedge, trees, bars, lawn)
    make = makers[int(rng.integers(len(makers)))]
    if ground.rails_v_m is not None and make in (trees, hedge):  # a bed of tracks leaves no room for them
        make = bars
    _everywhere(builder, make, Stretch(-85.0, 170.0, 1.0, ground.half_width_m + rng.uniform(0.3, 0.6)))


def _backdrop(builder: Builder, side: float, edge: float) -> None:
    """Houses and woods behind the second row, with some gaps: few views in a valley are open to the horizon."""
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
    """Trees right behind the kerb, whose crowns begin above most lasers."""
    rng, half = builder.rng, builder.ground.half_width_m
    step, tall = float(rng.uniform(5.0, 14.0)), float(rng.uniform(2.2, 5.0))
    across = side * (half + float(rng.uniform(0.4, max(0.8, 0.5 * builder.ground.pavement_m))))
    for along in np.arange(-80.0, 80.0, step):
        if rng.random() < 0.85 and not builder.near_junction(along, along):
            tree(builder, float(along + rng.normal(0, 0.3)), float(across + rng.normal(0, 0.1)), tall_m=tall)


def lawn(builder: Builder, stretch: Stretch) -> None:
    """Open ground, perhaps with one tree."""
    if builder.rng.random() < 0.5:
        away = stretch.away_m + builder.rng.uniform(0.3, 8.0)
        tree(builder, stretch.middle_m, stretch.side * away, stretch.cross)


# What stands beside a kind of street, by share.
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
