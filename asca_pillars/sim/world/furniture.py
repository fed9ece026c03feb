"""Street furniture: poles, bollards, cabinets, bins, benches, shelters, boards, beacons and masts."""

import numpy as np

from asca_pillars.sim.world.builder import Builder, Material
from asca_pillars.sim.world.vegetation import crown


def material(builder: Builder) -> Material:
    """Return any painted, galvanized or bare surface."""
    return (float(builder.rng.uniform(0.06, 0.6)), 0.4, 0.0)


def pole(builder: Builder, along: float, across: float) -> None:
    """Add a lamp, a sign, a traffic light, a mast."""
    rng = builder.rng
    mast = rng.random() < 0.15
    radius = float(rng.uniform(0.12, 0.3) if mast else rng.uniform(0.03, 0.12))
    if not builder.reserve(along, across, 2 * radius, 2 * radius):
        return
    tilt = rng.normal(0.0, 0.015, 2)
    builder.post(
        along,
        across,
        -0.3,
        float(rng.uniform(2.2, 7.0)),
        radius,
        float(rng.uniform(0.1, 0.6)),
        taper=float(rng.uniform(0.6, 1.0)),
        lean=(float(tilt[0]), float(tilt[1])),
    )
    what = rng.random()
    if what < 0.35:  # signs are retroreflective; from the side they are a line
        size = float(rng.uniform(0.35, 0.95))
        yaw = float(rng.choice([0.0, 0.0, 1.57]) + rng.normal(0, 0.3))
        for z in (rng.uniform(1.2, 2.6),) if rng.random() < 0.75 else (1.5, 2.3):
            builder.box(along, across, float(z), (0.04, size, size), (float(rng.uniform(0.4, 0.9)), 0.4, 0.0), yaw=yaw)
    elif what < 0.5:  # traffic lights, one for drivers and one for pedestrians
        for z in (2.1, float(rng.uniform(1.2, 1.6))):
            builder.box(along, across, z, (0.25, 0.3, 0.8), (0.12, 0.4, 0.0), yaw=float(rng.normal(0, 0.5)))
    elif what < 0.65:  # a base with the fuses
        builder.post(along, across, -0.2, float(rng.uniform(0.8, 1.4)), 1.8 * radius, 0.3)
    elif what < 0.90:  # sacks, plants or a sheet tied to it
        wrapped(builder, along, across, float(rng.uniform(0.14, 0.3)), float(rng.uniform(0.9, 1.8)))
    else:  # a litter bin on it
        builder.box(along + 0.25, across, 0.6, (0.35, 0.4, 0.6), material(builder))


def wrapped(builder: Builder, along: float, across: float, wide_m: float, tall_m: float) -> None:
    """Add an uneven upright object under a sheet or covered with plants, `wide_m` in radius."""
    rng = builder.rng
    pieces, reflectance = int(rng.integers(3, 7)), float(rng.uniform(0.12, 0.6))
    for i in range(pieces):
        radii = (wide_m * float(rng.uniform(0.6, 1.2)), wide_m * float(rng.uniform(0.6, 1.2)), 0.7 * tall_m / pieces)
        shift = rng.normal(0.0, 0.2 * wide_m, 2)
        z = (i + 0.5) * tall_m / pieces
        builder.ball(along + float(shift[0]), across + float(shift[1]), z, radii, reflectance)


def pole_group(builder: Builder, along: float, across: float) -> None:
    """Add two to five posts close together, as at crossings: from afar as wide as a person."""
    rng = builder.rng
    for _ in range(int(rng.integers(2, 6))):
        at, lateral = along + float(rng.normal(0, 0.35)), across + float(rng.normal(0, 0.35))
        radius = float(rng.uniform(0.025, 0.09))
        if builder.reserve(at, lateral, 2 * radius, 2 * radius):
            builder.post(at, lateral, -0.2, float(rng.uniform(1.2, 4.5)), radius, float(rng.uniform(0.1, 0.6)))


def bollards(builder: Builder, along: float, across: float) -> None:
    """Add a row of short posts."""
    rng = builder.rng
    radius, height = float(rng.uniform(0.03, 0.18)), float(rng.uniform(0.4, 1.3))
    reflectance, step = float(rng.uniform(0.1, 0.6)), float(rng.uniform(1.0, 2.5))
    for i in range(int(rng.integers(1, 9))):
        if builder.reserve(along + i * step, across, 2 * radius, 2 * radius):
            builder.post(along + i * step, across, -0.2, height + 0.2, radius, reflectance)


def delineators(builder: Builder, along: float, across: float) -> None:
    """Add white posts with reflectors, or cones, in a row along the road."""
    rng = builder.rng
    cone = rng.random() < 0.4
    step = float(rng.uniform(2.0, 5.0) if cone else rng.uniform(12.0, 25.0))
    for i in range(int(rng.integers(1, 6))):
        at = along + i * step
        if builder.near_junction(at, at) or not builder.reserve(at, across, 0.3, 0.3):
            continue
        if cone:
            builder.post(at, across, 0.0, float(rng.uniform(0.4, 1.0)), 0.18, 0.5, taper=0.15)
        else:
            builder.box(at, across, -0.2, (0.12, 0.1, 1.2), (float(rng.uniform(0.5, 0.9)), 0.3, 0.0))


def cabinet(builder: Builder, along: float, across: float) -> None:
    """Add a switch cabinet, a post box, a hydrant's hood, a grit box, several side by side."""
    rng = builder.rng
    size = (float(rng.uniform(0.25, 1.6)), float(rng.uniform(0.2, 0.7)), float(rng.uniform(0.6, 2.0)))
    yaw = float(rng.choice([0.0, 1.57]) + rng.normal(0, 0.1))
    for i in range(int(rng.choice([1, 1, 1, 2, 3]))):
        at = along + i * (max(size[:2]) + 0.1)
        if builder.reserve(at, across, max(size[:2]), max(size[:2])):
            height = size[2] * float(rng.uniform(0.7, 1.1))
            builder.box(at, across, -0.2, (size[0], size[1], height + 0.2), material(builder), yaw=yaw)


def bins(builder: Builder, along: float, across: float) -> None:
    """Add wheeled bins in a row, small or large ones."""
    rng = builder.rng
    size = (1.3, 0.95, 1.35) if rng.random() < 0.25 else (0.52, 0.6, 1.05)
    for i in range(int(rng.integers(1, 7))):
        at, lateral = along + i * (size[0] + float(rng.uniform(0.03, 0.3))), across + float(rng.normal(0, 0.08))
        if builder.reserve(at, lateral, size[0], size[1]):
            yaw = float(rng.normal(0, 0.15))
            builder.box(at, lateral, 0.08, (size[0], size[1], size[2] - 0.15), material(builder), yaw=yaw)
            builder.box(at, lateral, size[2] - 0.07, (size[0], 1.08 * size[1], 0.07), (0.1, 0.4, 0.0), yaw=yaw)


def bench(builder: Builder, along: float, across: float) -> None:
    """Add a bench, or two with a table between."""
    rng = builder.rng
    table = rng.random() < 0.3
    if not builder.reserve(along, across, 1.8, 1.7 if table else 0.7):
        return
    plank = material(builder)
    if table:
        builder.box(along, across, 0.7, (1.7, 0.75, 0.06), plank)
    for lateral in (-0.6, 0.6) if table else (0.0,):
        builder.box(along, across + lateral, 0.40, (1.7, 0.4, 0.06), plank)
        for leg in (-0.7, 0.7):
            builder.box(along + leg, across + lateral, -0.1, (0.08, 0.35, 0.5), plank)
    if not table and rng.random() < 0.7:
        builder.box(along, across + (0.22 if across > 0 else -0.22), 0.5, (1.7, 0.05, 0.4), plank)


def planter(builder: Builder, along: float, across: float) -> None:
    """Add a tub with a plant in it."""
    rng = builder.rng
    size = (float(rng.uniform(0.5, 2.0)), float(rng.uniform(0.5, 1.0)), float(rng.uniform(0.3, 0.8)))
    if builder.reserve(along, across, *size[:2]):
        builder.box(along, across, -0.1, (size[0], size[1], size[2] + 0.1), material(builder))
        wide, tall = 0.5 * min(size[:2]), float(rng.uniform(0.15, 0.7))
        crown(builder, along, across, size[2] + tall, (wide, tall), float(rng.uniform(1.5, 6.0)), cross=False)


def shelter(builder: Builder, along: float, across: float) -> None:
    """Add a roof on posts with glass behind, at a stop; or a kiosk, or a telephone box."""
    rng = builder.rng
    booth = rng.random() < 0.4
    size = (0.9, 0.9, 2.3) if booth else (float(rng.uniform(2.5, 5.0)), 1.5, 2.5)
    if not builder.reserve(along, across, *size[:2]):
        return
    glass = (0.06, 2.0, 0.0 if booth and rng.random() < 0.4 else float(rng.uniform(0.6, 0.95)))
    back = across + 0.7 * (1.0 if across > 0 else -1.0)
    builder.box(along, across, size[2], (size[0], size[1], 0.12), material(builder))
    if booth:
        builder.box(along, across, 0.0, size, glass)
    else:
        builder.box(along, back, 0.15, (size[0], 0.03, 2.1), glass)
        builder.box(along + size[0] / 2, across, 0.15, (0.06, 1.2, 2.0), (0.4, 0.4, float(rng.choice([0.0, 0.8]))))
        builder.box(along, back - (0.35 if across > 0 else -0.35), 0.42, (0.6 * size[0], 0.35, 0.06), (0.3, 0.4, 0.0))
    for at in (-0.45, 0.45):
        builder.post(along + at * size[0], back if not booth else across, -0.1, size[2] + 0.1, 0.05, 0.3)


def billboard(builder: Builder, along: float, across: float) -> None:
    """Add a board on legs, a board on the ground, a round pillar for posters."""
    rng = builder.rng
    if rng.random() < 0.25:
        radius = float(rng.uniform(0.45, 0.75))
        if builder.reserve(along, across, 2 * radius, 2 * radius):
            builder.post(along, across, -0.2, float(rng.uniform(2.4, 3.8)), radius, float(rng.uniform(0.2, 0.6)))
        return
    wide = float(rng.choice([0.6, 1.3, 1.3, 3.6]))
    yaw = float(rng.choice([0.0, 1.57]) + rng.normal(0, 0.15))
    if builder.reserve(along, across, wide, wide if yaw > 0.8 else 0.5):
        foot = float(rng.choice([0.0, 0.3, 0.8, 2.0]))
        builder.box(along, across, foot, (wide, 0.12, float(rng.uniform(0.9, 2.6))), material(builder), yaw=yaw)
        builder.post(along, across, -0.2, foot + 0.3, 0.06, 0.3)


def barrier_boards(builder: Builder, along: float, across: float) -> None:
    """Add red and white boards or mesh on feet around works, with a heap inside."""
    rng = builder.rng
    mesh = rng.random() < 0.4
    step, height = (3.4, 2.0) if mesh else (float(rng.uniform(1.2, 2.2)), 1.0)
    board: Material = (0.35, 0.4, 0.88) if mesh else (float(rng.uniform(0.4, 0.8)), 0.4, 0.0)
    for i in range(int(rng.integers(1, 7))):
        at, lateral = along + i * step, across + float(rng.normal(0, 0.1))
        if builder.near_junction(at, at) or not builder.reserve(at, lateral, step - 0.1, 0.3):
            continue
        builder.box(at - step / 2, lateral, -0.05, (0.25, 0.6, 0.15), (0.1, 0.3, 0.0))
        builder.post(at - step / 2, lateral, 0.0, height + 0.1, 0.025, 0.4)
        builder.box(at, lateral, 0.15 if mesh else height - 0.3, (step, 0.03, height - 0.15 if mesh else 0.25), board)


def low_stones(builder: Builder, along: float, across: float) -> None:
    """Add kerb stones, wheel stops, steps or speed cushions: short low bars."""
    rng = builder.rng
    length, yaw = float(rng.uniform(0.8, 3.0)), float(rng.choice([0.0, 1.57]) + rng.normal(0, 0.1))
    height, step = float(rng.uniform(0.06, 0.35)), length + float(rng.uniform(0.0, 0.8))
    stone = (float(rng.uniform(0.15, 0.5)), 0.3, 0.0)
    for i in range(int(rng.integers(1, 6))):
        if builder.reserve(along + i * step, across, length, length if yaw > 0.8 else 0.3):
            builder.box(
                along + i * step,
                across,
                -0.1,
                (length, float(0.15 + rng.uniform(0, 0.2)), height + 0.1),
                stone,
                yaw=yaw,
            )


def island(builder: Builder, along: float, across: float) -> None:
    """Add a traffic island with its posts and signs, in the middle of the road before a junction."""
    rng = builder.rng
    length, width = float(rng.uniform(2.0, 6.0)), float(rng.uniform(0.8, 1.8))
    if not builder.reserve(along, across, length, width):
        return
    builder.box(along, across, -0.2, (length, width, 0.2 + float(rng.uniform(0.06, 0.16))), (0.35, 0.3, 0.0))
    for end in (-0.4, 0.4):
        at, size = along + end * length, float(rng.uniform(0.3, 0.7))
        builder.post(at, across, 0.0, float(rng.uniform(0.9, 3.0)), float(rng.uniform(0.03, 0.09)), 0.4)
        if rng.random() < 0.6:
            builder.box(at, across, float(rng.uniform(0.5, 2.0)), (0.05, size, size), (0.8, 0.4, 0.0))


def retroreflective(builder: Builder) -> Material:
    """Return retroreflective foil: the sensor reports 0.6 to 0.99, also at large distances."""
    return (float(np.exp(builder.rng.uniform(np.log(0.8), np.log(5.0)))), 0.3, 0.0)


def beacon(builder: Builder, along: float, across: float) -> None:
    """Add guidance beacons on feet, in a row or alone: a board as wide as a leg, as tall as a child."""
    rng = builder.rng
    size = (0.06, float(rng.uniform(0.2, 0.35)), float(rng.uniform(0.7, 1.15)))
    foil, step = retroreflective(builder), float(rng.uniform(2.5, 8.0))
    yaw = float(rng.choice([0.0, 0.0, 1.57]) + rng.normal(0, 0.3))
    for i in range(int(rng.choice([1, 1, 1, 2, 4]))):
        at = along + i * step
        if not builder.near_junction(at, at) and builder.reserve(at, across, 0.4, 0.4):
            foot = float(rng.uniform(0.08, 0.3))
            builder.box(at, across, -0.05, (0.4, 0.35, 0.15), (0.1, 0.3, 0.0), yaw=yaw)
            builder.box(at, across, foot, size, foil, yaw=yaw)
            if rng.random() < 0.3:  # a lamp on top
                builder.ball(at, across, foot + size[2] + 0.08, (0.09, 0.09, 0.11), 0.6)


def striped_post(builder: Builder, along: float, across: float) -> None:
    """Add a round or square post with bands, every other one of foil, with a cap, a sign or nothing on it."""
    rng = builder.rng
    wide, tall = float(rng.uniform(0.12, 0.35)), float(rng.uniform(0.8, 1.5))
    if not builder.reserve(along, across, wide, wide):
        return
    foil, paint = retroreflective(builder), material(builder)
    bands = int(rng.integers(2, 6))
    round_one = rng.random() < 0.5
    for i in range(bands):
        band = foil if i % 2 else paint
        z, height = -0.1 + i * (tall + 0.1) / bands, (tall + 0.1) / bands
        if round_one:
            builder.post(along, across, z, height, wide / 2, band[0])
        else:
            builder.box(along, across, z, (wide, wide, height), band)
    if rng.random() < 0.35:
        size = float(rng.uniform(0.25, 0.6))
        builder.box(along, across, tall, (0.05, size, size), foil, yaw=float(rng.normal(0, 0.4)))


def board(builder: Builder, along: float, across: float) -> None:
    """Add a narrow upright board near the ground: a striped plate, an arrow, a poster, some of them retroreflective."""
    rng = builder.rng
    size = (0.05, float(rng.uniform(0.2, 0.55)), float(rng.uniform(0.8, 1.5)))
    if not builder.reserve(along, across, size[1], size[1]):
        return
    face = retroreflective(builder) if rng.random() < 0.6 else material(builder)
    foot = float(rng.uniform(0.0, 0.5))
    yaw = float(rng.choice([0.0, 1.57]) + rng.normal(0, 0.35))
    builder.box(along, across, foot, size, face, yaw=yaw)
    builder.post(along, across, -0.2, foot + 0.4 * size[2] + 0.2, 0.035, 0.35)


def leaning_board(builder: Builder, along: float, across: float) -> None:
    """Add a board, plank or sheet leaning on a post: stacked slices, each farther from the foot."""
    rng = builder.rng
    wide, tall = float(rng.uniform(0.25, 0.7)), float(rng.uniform(0.9, 1.8))
    if not builder.reserve(along, across, 0.8, 0.8):
        return
    face, slices, lean = material(builder), 5, float(rng.uniform(0.15, 0.45))
    for i in range(slices):
        lateral = across + lean * tall * (i / slices - 0.5)
        builder.box(along, lateral, i * tall / slices, (wide, 0.08, tall / slices), face)
    builder.post(along, across + 0.5 * lean * tall + 0.1, -0.2, float(rng.uniform(1.5, 4.0)), 0.05, 0.35)


def mast(builder: Builder, along: float, across: float) -> None:
    """Add a mast, thin or thick, with boxes as high as a person, bands of tape, notices and a wider foot."""
    rng = builder.rng
    radius = float(rng.uniform(0.03, 0.09) if rng.random() < 0.6 else rng.uniform(0.09, 0.28))
    if not builder.reserve(along, across, 0.6, 0.6):
        return
    builder.post(along, across, -0.3, float(rng.uniform(2.4, 7.0)), radius, float(rng.uniform(0.15, 0.5)), taper=0.85)
    if rng.random() < 0.6:
        builder.post(along, across, -0.2, float(rng.uniform(0.3, 1.2)), 1.5 * radius, float(rng.uniform(0.15, 0.5)))
    z = float(rng.uniform(0.2, 0.8))
    for _ in range(int(rng.integers(1, 4))):
        size = (float(rng.uniform(0.15, 0.4)), float(rng.uniform(0.25, 0.6)), float(rng.uniform(0.25, 0.8)))
        turn = float(rng.uniform(0, 2 * np.pi))
        at, lateral = along + radius * np.cos(turn), across + radius * np.sin(turn)
        builder.box(float(at), float(lateral), z, size, material(builder), yaw=turn)
        z += size[2] * float(rng.uniform(0.6, 1.2))
    if rng.random() < 0.5:  # tape or a notice
        z, height = float(rng.uniform(0.5, 1.6)), float(rng.uniform(0.1, 0.5))
        builder.post(along, across, z, height, radius + 0.02, retroreflective(builder)[0])


def covered_thing(builder: Builder, along: float, across: float) -> None:
    """Add an object under a sheet, in a sack or covered with plants: a pump, a statue, stacked chairs, a parasol.

    Some are tied to a pole.
    """
    rng = builder.rng
    wide, tall = float(rng.uniform(0.14, 0.34)), float(rng.uniform(0.9, 1.9))
    if not builder.reserve(along, across, 2.2 * wide, 2.2 * wide):
        return
    wrapped(builder, along, across, wide, tall)
    if rng.random() < 0.4:
        aside = float(rng.normal(0.0, wide))
        builder.post(along + aside, across, -0.2, float(rng.uniform(2.2, 5.0)), float(rng.uniform(0.03, 0.09)), 0.35)


def wall_end(builder: Builder, along: float, across: float) -> None:
    """Add end of a wall: a stub, a pillar before it, a gap."""
    rng = builder.rng
    length, thick, tall = float(rng.uniform(0.3, 1.6)), float(rng.uniform(0.15, 0.4)), float(rng.uniform(0.7, 2.2))
    if builder.reserve(along, across, length, length):
        stone = material(builder)
        yaw = float(rng.choice([0.0, 1.57]) + rng.normal(0, 0.1))
        builder.box(along, across, -0.3, (length, thick, tall + 0.3), stone, yaw=yaw)
        if rng.random() < 0.5:
            lateral = across + (0.5 * length if yaw > 0.8 else 0.0)
            builder.box(
                along if yaw > 0.8 else along + 0.5 * length,
                lateral,
                -0.3,
                (thick + 0.12, thick + 0.12, tall + 0.5),
                stone,
            )


def fragments(builder: Builder, along: float, across: float) -> None:
    """Add some uneven pieces close together, with a few returns each for a distant sensor."""
    rng = builder.rng
    tall = float(rng.uniform(0.3, 1.9))
    for _ in range(int(rng.integers(1, 4))):
        at, lateral = along + float(rng.normal(0, 0.4)), across + float(rng.normal(0, 0.4))
        size = (float(rng.uniform(0.08, 0.4)), float(rng.uniform(0.08, 0.4)), tall * float(rng.uniform(0.4, 1.0)))
        if builder.reserve(at, lateral, size[0], size[1]):
            foot = 0.0 if rng.random() < 0.7 else float(rng.uniform(0.1, 0.6))
            builder.box(at, lateral, foot - 0.05, size, material(builder), yaw=float(rng.uniform(0, 3.1)))


def low_pieces(builder: Builder, along: float, across: float) -> None:
    """Add sparse objects hardly higher than a kerb."""
    rng = builder.rng
    for _ in range(int(rng.integers(1, 6))):
        at, lateral = along + float(rng.normal(0, 1.5)), across + float(rng.normal(0, 1.0))
        size = (float(rng.uniform(0.15, 1.0)), float(rng.uniform(0.15, 0.6)), float(rng.uniform(0.1, 0.7)))
        if builder.reserve(at, lateral, size[0], size[1]):
            builder.box(at, lateral, -0.1, (size[0], size[1], size[2] + 0.1), material(builder))
