"""Objects on pavements, verges and in yards, many as large as a person or a car; some occlude labelled objects."""

import math
from bisect import bisect_left
from collections.abc import Callable, Sequence

import numpy as np

from asca_pillars.sim.bodies.people import motorbike_body, parked_bicycle_body
from asca_pillars.sim.world.builder import Builder, Material
from asca_pillars.sim.world.distractors import distractor
from asca_pillars.sim.world.furniture import (
    barrier_boards,
    beacon,
    bench,
    billboard,
    bins,
    board,
    bollards,
    cabinet,
    covered_thing,
    delineators,
    fragments,
    island,
    leaning_board,
    low_pieces,
    low_stones,
    mast,
    material,
    planter,
    pole,
    pole_group,
    shelter,
    striped_post,
    wall_end,
)
from asca_pillars.sim.world.low_clutter import (
    banded_bollards,
    before_a_wall,
    bicycle_at_post,
    cabinet_and_panel,
    footed_trunk,
    litter_bin,
    low_sign,
    posts_at_corners,
    slim_pillars,
    tapered_stone,
    wall_corner,
    warning_barrier,
)
from asca_pillars.sim.world.placement import Target
from asca_pillars.sim.world.vegetation import bush, hedge_block, shrub, tree, weeds


def thin_cylinder(builder: Builder, along: float, across: float) -> None:
    """Add a round object as tall as a person: a stump, a pipe, a rolled carpet, a wrapped tree."""
    rng = builder.rng
    radius = float(rng.uniform(0.08, 0.28))
    if builder.reserve(along, across, 2 * radius, 2 * radius):
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
    """Add a parking meter, letter box, counter, pump or bird house: something wide on something thin."""
    rng = builder.rng
    size = (float(rng.uniform(0.15, 0.5)), float(rng.uniform(0.2, 0.6)), float(rng.uniform(0.25, 0.9)))
    if builder.reserve(along, across, 0.5, 0.5):
        top = float(rng.uniform(0.9, 2.1))
        builder.post(along, across, -0.2, top, float(rng.uniform(0.03, 0.1)), float(rng.uniform(0.1, 0.5)))
        builder.box(along, across, top - size[2], size, material(builder), yaw=float(rng.uniform(0, 3.1)))


def column(builder: Builder, along: float, across: float) -> None:
    """Add an upright slab or pillar: a stone, a gate's pillar, an advertising stele, a stack of chairs."""
    rng = builder.rng
    size = (float(rng.uniform(0.2, 0.7)), float(rng.uniform(0.15, 0.7)), float(rng.uniform(1.0, 2.4)))
    if builder.reserve(along, across, 0.8, 0.8):
        builder.box(
            along, across, -0.2, (size[0], size[1], size[2] + 0.2), material(builder), yaw=float(rng.uniform(0, 3.1))
        )


def container(builder: Builder, along: float, across: float) -> None:
    """Add a skip, a container for glass or clothes, a building site's box, a small transformer house."""
    rng = builder.rng
    length, width = float(rng.uniform(1.2, 6.0)), float(rng.uniform(1.0, 2.4))
    height = float(rng.uniform(0.9, 2.7))
    if not builder.reserve(along, across, length, width):
        return
    paint = material(builder)
    if rng.random() < 0.5:
        builder.box(along, across, -0.1, (length, width, height + 0.1), paint)
    else:  # an open skip, whose ends slope outward: a smaller base below a larger rim
        builder.box(along, across, -0.1, (0.65 * length, 0.9 * width, height + 0.1), paint)
        builder.box(along, across, 0.45 * height, (0.85 * length, 0.95 * width, 0.3 * height), paint)
        builder.box(along, across, 0.72 * height, (length, width, 0.28 * height), paint)


def heap(builder: Builder, along: float, across: float) -> None:
    """Add earth, gravel, leaves, boulders or bags: low round mounds."""
    rng = builder.rng
    wide = float(np.exp(rng.uniform(np.log(0.2), np.log(2.4))))
    if not builder.reserve(along, across, 1.6 * wide, 1.2 * wide):
        return
    reflectance, tall = float(rng.uniform(0.15, 0.5)), float(rng.uniform(0.25, 0.6)) * wide
    for _ in range(int(rng.integers(2, 7))):
        shift, size = rng.normal(0.0, 0.25, 2) * wide, rng.uniform(0.3, 0.6, 3)
        radii = (float(size[0]) * wide, float(size[1]) * 0.8 * wide, float(size[2] + 0.4) * tall)
        builder.ball(along + float(shift[0]), across + 0.6 * float(shift[1]), 0.0, radii, reflectance)


def stack(builder: Builder, along: float, across: float) -> None:
    """Add pallets, timber, bricks or boxes: uneven blocks on and beside each other."""
    rng = builder.rng
    length, width, height = float(rng.uniform(0.6, 4.5)), float(rng.uniform(0.5, 1.8)), float(rng.uniform(0.5, 1.9))
    if not builder.reserve(along, across, length, width):
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
    """Add bicycles without riders, which KITTI does not label: a few, or a full rack."""
    rng = builder.rng
    leaning = np.pi / 2 if rng.random() < 0.6 else 0.0
    number = int(rng.integers(4, 12)) if leaning and rng.random() < 0.4 else int(rng.integers(1, 5))
    step = float(rng.uniform(0.45, 0.8)) if leaning else 2.0
    length, width = (0.4, 1.75) if leaning else (1.75, 0.55)
    bodies = [parked_bicycle_body(rng) for _ in range(min(number, 2))]  # racks repeat them: drawing is slow
    for i in range(number):
        place = along + i * step
        if builder.reserve(place, across, length, width):
            builder.body(bodies[i % 2], place, across, leaning + float(rng.choice([0.0, np.pi]) + rng.normal(0, 0.12)))


def parked_motorbikes(builder: Builder, along: float, across: float) -> None:
    """Add one to four motorcycles side by side."""
    rng = builder.rng
    turned = float(rng.choice([0.0, 0.9, np.pi / 2]))
    length, width = (2.0, 0.8) if turned == 0.0 else (0.9, 2.1)
    for place in along + (2.3 if turned == 0.0 else 1.0) * np.arange(int(rng.integers(1, 5))):
        if builder.reserve(place, across, length, width):
            builder.body(motorbike_body(rng), place, across, turned + float(rng.normal(0, 0.1)))


Thing = Callable[[Builder, float, float], None]
SCATTERED_WITHIN_M = 38.0  # of the road's middle


def scatter(builder: Builder) -> None:
    """Add clutter along both sides of the main road, mostly right behind the kerb, some far from any road."""
    rng, ground = builder.rng, builder.ground
    pavement = ground.pavement_m
    things, weights = zip(*SHARES.items(), strict=True)
    upto = (np.cumsum(weights) / sum(weights)).tolist()
    number = rng.uniform(*builder.config.clutter)
    for _ in range(rng.poisson(1.6 * number)):  # 160 m of street
        along = float(rng.uniform(-80, 80))
        side = 1.0 if rng.random() < 0.5 else -1.0
        edge = ground.left_edge_m if side > 0 and rng.random() < 0.7 else ground.half_width_m
        lateral = rng.uniform(0.25, 0.8) if rng.random() < 0.35 else rng.uniform(0.3, pavement + 6.0)
        if rng.random() < 0.22:
            edge, lateral = 0.0, rng.uniform(edge + 2.0, SCATTERED_WITHIN_M)
        elif rng.random() < 0.07:  # between parked cars, as planted build-outs of the kerb are
            lateral = -rng.uniform(0.3, 1.8)
        if not builder.near_junction(along, along):
            _add(builder, things[bisect_left(upto, rng.random())], along, float(side * (edge + lateral)))
    for _ in range(rng.poisson(builder.config.far_clutter)):
        along = float(rng.choice([-1.0, 1.0]) * rng.uniform(28.0, 75.0))
        across = float(rng.choice([-1.0, 1.0]) * (ground.half_width_m + rng.uniform(0.0, 30.0)))
        if not builder.near_junction(along, along):
            _add(builder, FAR[int(rng.integers(len(FAR)))], along, across)
    if ground.cross_half_m > 0 and rng.random() < 0.35:
        reach = ground.cross_half_m + rng.uniform(1.5, 5.0)
        island(builder, ground.cross_u_m + float(rng.choice([-1.0, 1.0])) * reach, 0.0)


def any_shrub(builder: Builder, along: float, across: float) -> None:
    """Add a low or tall shrub."""
    shrub(builder, along, across, tall=bool(builder.rng.random() < 0.35))


FAR: tuple[Thing, ...] = (
    low_pieces,
    low_pieces,
    low_pieces,
    fragments,
    weeds,
    covered_thing,
    board,
    mast,
    low_sign,
    tapered_stone,
    footed_trunk,
    banded_bollards,
)  # low and sparse clutter beyond 28 m
SHARES: dict[Thing, float] = {
    pole: 0.09,
    pole_group: 0.04,
    bollards: 0.04,
    delineators: 0.04,
    cabinet: 0.04,
    bins: 0.06,
    bench: 0.03,
    planter: 0.03,
    shelter: 0.012,
    billboard: 0.025,
    barrier_boards: 0.02,
    low_stones: 0.05,
    thin_cylinder: 0.025,
    post_with_box: 0.04,
    column: 0.025,
    container: 0.015,
    heap: 0.03,
    stack: 0.025,
    hedge_block: 0.035,
    parked_bicycles: 0.04,
    parked_motorbikes: 0.013,
    any_shrub: 0.06,
    bush: 0.035,
    tree: 0.05,
    weeds: 0.13,
    beacon: 0.06,
    striped_post: 0.08,
    board: 0.08,
    leaning_board: 0.04,
    mast: 0.10,
    covered_thing: 0.07,
    wall_end: 0.03,
    fragments: 0.05,
    low_pieces: 0.03,
    banded_bollards: 0.09,
    litter_bin: 0.06,
    cabinet_and_panel: 0.03,
    before_a_wall: 0.05,
    footed_trunk: 0.06,
    tapered_stone: 0.05,
    slim_pillars: 0.05,
    low_sign: 0.06,
    warning_barrier: 0.04,
    bicycle_at_post: 0.02,
    wall_corner: 0.06,
    posts_at_corners: 0.03,
}


STEP_M, LANE_OF_SIGHT_M = 1.5, 2.0


def _tall_shrub(builder: Builder, along: float, across: float) -> None:
    shrub(builder, along, across, tall=True)


BEFORE: tuple[Thing, ...] = (_tall_shrub, _tall_shrub, bush, pole, mast, tree, cabinet, post_with_box)
BEHIND: tuple[Thing, ...] = (
    fragments,
    fragments,
    board,
    post_with_box,
    thin_cylinder,
    wall_end,
    slim_pillars,
    litter_bin,
)


def hide_partly(builder: Builder, targets: Sequence[Target]) -> None:
    """Put one to three things before each target, and keep the rest of the way to it open."""
    rng = builder.rng
    for target in targets:
        x, y, _, length, width, _, yaw = target.box
        distance, bearing = math.hypot(x, y), math.atan2(y, x)
        seen = length * abs(math.sin(yaw - bearing)) + width * abs(math.cos(yaw - bearing))
        for _ in range(int(rng.integers(1, 4))):
            share, aside = rng.uniform(0.6, 0.9), rng.uniform(-0.5, 0.5) * seen
            _put(builder, BEFORE, share * x - aside * math.sin(bearing), share * y + aside * math.cos(bearing))
        for way in np.arange(8.0, distance - 0.5 * length - 0.5 * STEP_M, STEP_M):
            # A little shorter than the step, as pieces may not touch.
            x, y = way * math.cos(bearing), way * math.sin(bearing)
            builder.occupied.take(x, y, STEP_M - 0.1, LANE_OF_SIGHT_M, bearing)


def fill_gaps(builder: Builder, targets: Sequence[Target]) -> None:
    """Put fragments behind the ends of vehicles, where one sees a narrow piece of them."""
    rng = builder.rng
    for target in targets:
        if target.type not in ("Car", "Van") or rng.random() >= builder.config.behind_gaps:
            continue
        x, y, _, length, width, _, yaw = target.box
        end = rng.choice([-1.0, 1.0]) * (0.5 * length + rng.uniform(-0.2, 0.6))
        x, y = x + end * math.cos(yaw), y + end * math.sin(yaw)
        farther = 1.0 + (0.5 * width + rng.uniform(0.4, 2.5)) / max(math.hypot(x, y), 1.0)
        _put(builder, BEHIND, farther * x, farther * y)


def _put(builder: Builder, things: Sequence[Thing], x: float, y: float) -> None:
    _add(builder, things[int(builder.rng.integers(len(things)))], *builder.ground.to_road(float(x), float(y)))


def _add(builder: Builder, thing: Thing, along: float, across: float) -> None:
    """Add the thing, or with the probability `distractor_share` a distractor instead."""
    share = builder.config.distractor_share
    # Drawn only where it is asked for: other configurations have the streets that they always had.
    (distractor if share and builder.rng.random() < share else thing)(builder, along, across)
