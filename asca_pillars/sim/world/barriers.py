"""What parts streets from gardens and carriageways from each other: walls, fences, railings, guard rails."""

from asca_pillars.sim.world.builder import Builder, Material, Stretch
from asca_pillars.sim.world.vegetation import hedge


def wall(builder: Builder, stretch: Stretch) -> None:
    """A wall, sometimes with pillars, sometimes of steps that follow the slope."""
    rng = builder.rng
    _wall(builder, stretch, float(rng.uniform(0.3, 2.4)), pillars=bool(rng.random() < 0.4))


def high_wall(builder: Builder, stretch: Stretch) -> None:
    """A wall above the eye: against noise, of a yard, of an underpass."""
    _wall(builder, stretch, float(builder.rng.uniform(2.4, 5.0)), pillars=bool(builder.rng.random() < 0.3))


def _wall(builder: Builder, stretch: Stretch, height: float, pillars: bool) -> None:
    rng, across, cross = builder.rng, stretch.side * stretch.away_m, stretch.cross
    thick = float(rng.uniform(0.15, 0.4))
    stone = (float(rng.uniform(0.2, 0.55)), 0.3, 0.0)
    uneven = float(rng.choice([0.0, 0.0, 0.15]))
    for along in stretch.along(4.0):
        if builder.claim(along, across, 3.6, thick, cross):
            top = height + uneven * float(rng.normal())
            builder.box(along, across, -0.6, (4.0, thick, max(top, 0.2) + 0.6), stone, cross)
            if pillars:
                builder.box(along + 2.0, across, -0.6, (0.4, thick + 0.15, height + 0.8), stone, cross)


def fence(builder: Builder, stretch: Stretch) -> None:
    """Boards, pickets or wire between posts: the thinner, the more rays pass."""
    rng, across, cross = builder.rng, stretch.side * stretch.away_m, stretch.cross
    height, step = float(rng.uniform(0.8, 2.2)), float(rng.uniform(2.0, 3.5))
    reflectance = float(rng.uniform(0.15, 0.55))
    board = (reflectance, 0.4, float(rng.choice([0.0, 0.3, 0.6, 0.8, 0.93])))
    for along in stretch.along(step):
        if builder.claim(along, across, step - 0.2, 0.05, cross):
            builder.box(along, across, 0.08, (step, 0.04, height - 0.1), board, cross)
            builder.box(along + step / 2, across, -0.3, (0.09, 0.09, height + 0.35), (reflectance, 0.4, 0.0), cross)


def railing(builder: Builder, stretch: Stretch) -> None:
    """A low wall with bars on it between pillars, often with a hedge behind."""
    rng, side, cross = builder.rng, stretch.side, stretch.cross
    across = side * stretch.away_m
    base, top, thick = float(rng.uniform(0.15, 0.9)), float(rng.uniform(0.9, 1.7)), float(rng.uniform(0.15, 0.35))
    stone: Material = (float(rng.uniform(0.15, 0.45)), 0.3, 0.0)
    iron: Material = (float(rng.uniform(0.08, 0.35)), 0.5, 0.0)
    bars: Material = (iron[0], 0.5, float(rng.uniform(0.4, 0.85)))
    step = float(rng.uniform(2.0, 4.0))
    for along in stretch.along(step):
        if builder.claim(along, across, step - 0.3, thick, cross):
            builder.box(along, across, -0.5, (step, thick, base + 0.5), stone, cross)
            builder.box(along, across, base, (step, 0.03, max(top - base, 0.1)), bars, cross)
            builder.box(along, across, top - 0.04, (step, 0.05, 0.06), iron, cross)
            builder.box(along + step / 2, across, -0.5, (0.35, thick + 0.1, top + 0.6), stone, cross)
    if rng.random() < 0.5:
        hedge(builder, Stretch(stretch.start_m, stretch.length_m, side, stretch.away_m + 0.4, cross))


def bars(builder: Builder, stretch: Stretch) -> None:
    """Pedestrians' railing: posts and two or three level tubes."""
    rng, across, cross = builder.rng, stretch.side * stretch.away_m, stretch.cross
    height, step = float(rng.uniform(0.7, 1.2)), float(rng.uniform(1.5, 2.5))
    steel: Material = (float(rng.uniform(0.15, 0.5)), 0.5, 0.0)
    levels = int(rng.integers(1, 4))
    for along in stretch.along(step):
        if builder.claim(along, across, step - 0.1, 0.05, cross):
            builder.post(along - step / 2, across, -0.2, height + 0.2, 0.03, steel[0], cross)
            for level in range(levels):
                builder.box(along, across, height * (level + 1) / levels - 0.05, (step, 0.05, 0.05), steel, cross)


def guard_rail(builder: Builder, stretch: Stretch) -> None:
    """A steel rail on posts, single or on both sides of them."""
    rng = builder.rng
    steel: Material = (float(rng.uniform(0.2, 0.5)), 0.8, 0.0)
    across, cross = stretch.side * stretch.away_m, stretch.cross
    double, low = bool(rng.random() < 0.3), float(rng.uniform(0.35, 0.5))
    for along in stretch.along(4.0):
        if builder.claim(along, across, 3.6, 0.1, cross):
            builder.box(along, across, low, (4.0, 0.08, 0.31), steel, cross)
            if double:
                builder.box(along, across + 0.4 * stretch.side, low, (4.0, 0.08, 0.31), steel, cross)
            for post in (along, along + 2.0):
                builder.box(post, across + 0.15 * stretch.side, -0.2, (0.1, 0.1, low + 0.5), steel, cross)


def concrete_barrier(builder: Builder, stretch: Stretch) -> None:
    """Blocks with a broad foot, as beside trunk roads and works."""
    rng, across, cross = builder.rng, stretch.side * stretch.away_m, stretch.cross
    stone: Material = (float(rng.uniform(0.2, 0.45)), 0.3, 0.0)
    height = float(rng.uniform(0.75, 1.1))
    for along in stretch.along(3.0):
        if builder.claim(along, across, 2.9, 0.6, cross):
            builder.box(along, across, -0.2, (2.95, 0.6, 0.4), stone, cross)
            builder.box(along, across, 0.2, (2.95, 0.25, height - 0.2), stone, cross)
