"""Things on pavements, verges and in yards, much of it the size of a person, a bicycle or a car.

A detector must not take them for one. Nothing here has the shape of a labelled class.
"""

from bisect import bisect_left
from collections.abc import Callable

import numpy as np

from asca_pillars.sim.world.builder import Builder
from asca_pillars.sim.world.furniture import (
    barrier_boards,
    bench,
    billboard,
    bins,
    bollards,
    cabinet,
    delineators,
    island,
    low_stones,
    planter,
    pole,
    pole_group,
    shelter,
)
from asca_pillars.sim.world.lookalikes import (
    column,
    container,
    heap,
    parked_bicycles,
    parked_motorbikes,
    post_with_box,
    stack,
    thin_cylinder,
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
from asca_pillars.sim.world.markers import (
    beacon,
    board,
    covered_thing,
    fragments,
    leaning_board,
    low_pieces,
    mast,
    striped_post,
    wall_end,
)
from asca_pillars.sim.world.vegetation import bush, hedge_block, shrub, tree, weeds

Thing = Callable[[Builder, float, float], None]
SCATTERED_WITHIN_M = 38.0  # of the road's middle


def scatter(builder: Builder) -> None:
    """Clutter along both sides of the main road, most of it right behind the kerb, some of it far from any road."""
    rng, ground = builder.rng, builder.ground
    pavement = ground.pavement_m
    things, weights = zip(*SHARES.items(), strict=True)
    upto = (np.cumsum(weights) / sum(weights)).tolist()
    number = rng.uniform(*builder.config.clutter)
    for _ in range(rng.poisson(1.6 * number)):  # 160 m of street
        along = float(rng.uniform(-80, 80))
        side = 1.0 if rng.random() < 0.5 else -1.0
        edge = ground.left_edge_m if side > 0 and rng.random() < 0.7 else ground.half_width_m
        beside = rng.uniform(0.25, 0.8) if rng.random() < 0.35 else rng.uniform(0.3, pavement + 6.0)
        if rng.random() < 0.22:
            edge, beside = 0.0, rng.uniform(edge + 2.0, SCATTERED_WITHIN_M)
        elif rng.random() < 0.07:  # between parked cars, as planted build-outs of the kerb are
            beside = -rng.uniform(0.3, 1.8)
        if not builder.near_junction(along, along):
            things[bisect_left(upto, rng.random())](builder, along, float(side * (edge + beside)))
    for _ in range(rng.poisson(builder.config.far_clutter)):
        along = float(rng.choice([-1.0, 1.0]) * rng.uniform(28.0, 75.0))
        across = float(rng.choice([-1.0, 1.0]) * (ground.half_width_m + rng.uniform(0.0, 30.0)))
        if not builder.near_junction(along, along):
            FAR[int(rng.integers(len(FAR)))](builder, along, across)
    if ground.cross_half_m > 0 and rng.random() < 0.35:
        reach = ground.cross_half_m + rng.uniform(1.5, 5.0)
        island(builder, ground.cross_u_m + float(rng.choice([-1.0, 1.0])) * reach, 0.0)


def any_shrub(builder: Builder, along: float, across: float) -> None:
    """Low or tall."""
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
