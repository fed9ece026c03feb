"""What stands before labelled vehicles and behind the gaps between them."""

import math
from collections.abc import Callable, Sequence

import numpy as np

from asca_pillars.sim.world.builder import Builder
from asca_pillars.sim.world.furniture import cabinet, pole
from asca_pillars.sim.world.lookalikes import post_with_box, thin_cylinder
from asca_pillars.sim.world.low_clutter import litter_bin, slim_pillars
from asca_pillars.sim.world.markers import board, fragments, mast, wall_end
from asca_pillars.sim.world.placement import Target
from asca_pillars.sim.world.vegetation import bush, shrub, tree

STEP_M, LANE_OF_SIGHT_M = 1.5, 2.0
Thing = Callable[[Builder, float, float], None]


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
    things[int(builder.rng.integers(len(things)))](builder, *builder.ground.to_road(float(x), float(y)))
