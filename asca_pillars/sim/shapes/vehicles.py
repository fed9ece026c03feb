"""Cars, vans, trucks, buses and trams as triangle meshes around the origin: x ahead, wheels on z = 0.

A car is lofted: at stations along its length stand cross-sections (sill, waist, belt, roof), joined by panels that are
paint below the belt and glass above it. Bodies are given by the size of the BODY, not of the looser label box.
"""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from ..primitives import Primitives, Surface, cuboids, ellipsoids, quads

Floats = npt.NDArray[np.float64]
MIRROR = np.array([1.0, -1.0, 1.0])
_WHEEL = np.array([[np.cos(a), 0.0, np.sin(a)] for a in np.linspace(0, 2 * np.pi, 13)])


@dataclass(frozen=True)
class Profile:
    """Side view of a body style, as shares of length (from the nose) and of height.

    Attributes:
        top: (x, z) of the outline from nose to tail.
        glass: spans of x between which the top outline is a pane (windscreen, rear window).
        cabin: span of x that has side windows.
        belt: height of the belt line.
        tumble: half width of the roof over half width of the body.
        transparency: share of rays through the side windows.
        windows: whether the sides behind the front seats are glass.
    """

    top: tuple[tuple[float, float], ...]
    glass: tuple[tuple[float, float], ...]
    cabin: tuple[float, float]
    belt: float = 0.62
    tumble: float = 0.76


HATCHBACK = Profile(
    ((0.0, 0.36), (0.03, 0.50), (0.06, 0.58), (0.24, 0.66), (0.42, 0.97), (0.52, 1.0), (0.82, 0.97), (0.95, 0.66),
     (0.985, 0.60), (1.0, 0.36)),
    ((0.24, 0.42), (0.82, 0.95)), (0.30, 0.90),
)  # fmt: skip
SALOON = Profile(
    ((0.0, 0.36), (0.025, 0.50), (0.06, 0.58), (0.26, 0.66), (0.41, 0.97), (0.50, 1.0), (0.68, 0.97), (0.83, 0.72),
     (0.97, 0.68), (0.985, 0.58), (1.0, 0.36)),
    ((0.26, 0.41), (0.68, 0.83)), (0.32, 0.78),
)  # fmt: skip
ESTATE = Profile(
    ((0.0, 0.36), (0.025, 0.50), (0.06, 0.58), (0.25, 0.66), (0.40, 0.97), (0.50, 1.0), (0.88, 0.97), (0.97, 0.66),
     (0.99, 0.58), (1.0, 0.36)),
    ((0.25, 0.40), (0.88, 0.97)), (0.31, 0.94),
)  # fmt: skip
SUV = Profile(
    ((0.0, 0.36), (0.02, 0.54), (0.05, 0.62), (0.24, 0.68), (0.36, 0.97), (0.46, 1.0), (0.88, 0.98), (0.96, 0.68),
     (0.985, 0.60), (1.0, 0.36)),
    ((0.24, 0.36), (0.88, 0.96)), (0.28, 0.93), 0.65, 0.80,
)  # fmt: skip
PICKUP = Profile(
    ((0.0, 0.36), (0.02, 0.54), (0.05, 0.60), (0.24, 0.64), (0.34, 0.97), (0.40, 1.0), (0.56, 0.98), (0.60, 0.62),
     (0.98, 0.60), (0.99, 0.56), (1.0, 0.36)),
    ((0.24, 0.34), (0.56, 0.60)), (0.28, 0.58), 0.62, 0.82,
)  # fmt: skip
MINIVAN = Profile(
    ((0.0, 0.30), (0.02, 0.46), (0.05, 0.54), (0.15, 0.62), (0.33, 0.96), (0.42, 1.0), (0.92, 0.98), (0.98, 0.60),
     (0.99, 0.52), (1.0, 0.30)),
    ((0.15, 0.33), (0.92, 0.98)), (0.22, 0.95), 0.58, 0.84,
)  # fmt: skip
VAN = Profile(
    ((0.0, 0.24), (0.015, 0.36), (0.04, 0.44), (0.16, 0.52), (0.28, 0.93), (0.34, 1.0), (0.97, 0.99), (0.99, 0.80),
     (0.995, 0.40), (1.0, 0.24)),
    ((0.16, 0.28),), (0.18, 0.36), 0.52, 0.90,
)  # fmt: skip
CAR_STYLES = ((HATCHBACK, 0.42), (SALOON, 0.24), (ESTATE, 0.20), (SUV, 0.13), (PICKUP, 0.01))


def draw_paint(rng: np.random.Generator, dark_share: float = 0.45) -> Surface:
    """Paint: dark lacquers send hardly anything back, and every lacquer less the flatter it is met."""
    if rng.random() < dark_share:
        return Surface(float(np.exp(rng.uniform(np.log(0.004), np.log(0.05)))), float(rng.uniform(1.0, 3.0)))
    return Surface(float(np.exp(rng.uniform(np.log(0.2), np.log(0.7)))), float(rng.uniform(0.3, 1.4)))


def car_body(
    rng: np.random.Generator, length: float, width: float, height: float, profile: Profile, dark_share: float = 0.45
) -> Primitives:
    """A lofted car or van with wheels, mirrors, plates and seats behind its glass."""
    paint = draw_paint(rng, dark_share)
    pane = Surface(0.25, 6.0, float(rng.uniform(0.7, 0.95)))
    side = Surface(0.12, 3.0, float(rng.uniform(0.45, 0.95)))
    trim = Surface(float(rng.uniform(0.01, 0.08)), 0.8)
    wheel_x = np.array([rng.uniform(0.17, 0.21), rng.uniform(0.78, 0.83)])
    wheel_radius = float(rng.uniform(0.29, 0.34)) * min(1.0 + 0.25 * (height - 1.5), 1.3)
    clearance = float(rng.uniform(0.15, 0.24))

    top = np.array(profile.top)
    arch = wheel_radius + 0.06
    arches = (wheel_x[:, None] + np.array([-1.0, -0.75, 0.0, 0.75, 1.0]) * arch / length).ravel()
    x = np.unique(np.concatenate([top[:, 0], arches, [profile.cabin[0], profile.cabin[1]]]).clip(0, 1))
    z_top = np.interp(x, top[:, 0], top[:, 1]) * height
    to_wheel = np.abs(x[:, None] - wheel_x).min(axis=1) * length
    sill = np.maximum(clearance, np.sqrt(np.maximum(arch**2 - to_wheel**2, 0.0)) + 0.5 * wheel_radius)
    sill = np.where(to_wheel < arch, sill, clearance)
    sill = np.minimum(sill, z_top - 0.05)
    belt = np.minimum(profile.belt * height, z_top - 0.01)
    belt = np.maximum(belt, sill + 0.02)
    waist = 0.5 * (sill + belt)
    # Noses and tails are rounded in plan; the body is widest a little above the wheels.
    plan = width / 2 * (1.0 - 0.17 * np.maximum(1 - x / 0.10, 0) ** 2 - 0.12 * np.maximum(1 - (1 - x) / 0.07, 0) ** 2)
    over_belt = np.clip((z_top - belt) / max((1 - profile.belt) * height, 1e-6), 0.0, 1.0)
    roof = plan * (0.93 + (profile.tumble - 0.93) * over_belt)
    # Bumpers are bowed: their corners stand back from the middle.
    bow = float(rng.uniform(0.06, 0.2))
    back = bow * (np.maximum(1 - (1 - x) / 0.08, 0) - np.maximum(1 - x / 0.08, 0))
    along = (0.5 - x) * length + back
    half = np.stack([0.95 * plan, plan, 0.97 * plan, roof, 0.55 * roof], axis=1)
    high = np.stack([sill, waist, belt, z_top - 0.03 * over_belt, z_top], axis=1)
    section = np.stack([np.broadcast_to(along[:, None], half.shape), half, high], axis=2)  # (S,5,3), left side

    middle = (x[:-1] + x[1:]) / 2
    in_cabin = (middle > profile.cabin[0]) & (middle < profile.cabin[1]) & (over_belt[:-1] + over_belt[1:] > 0.5)
    pillar = rng.random(len(middle)) < 0.12
    in_pane = np.zeros(len(middle), bool)
    for begin, end in profile.glass:
        in_pane |= (middle > begin) & (middle < end)
    # Panels between neighboring stations: below the waist, to the belt, to the roof's edge, on to the lid; and the lid.
    table = np.broadcast_to(paint.row, (len(middle), 5, 3)).copy()
    table[in_cabin & ~pillar, 2] = side.row
    table[in_pane, 3:] = pane.row
    left = np.stack([section[:-1, :-1], section[1:, :-1], section[1:, 1:], section[:-1, 1:]], axis=2)  # (S-1,4,4,3)
    ridge = section[:, 4]
    lid = np.stack([ridge[:-1], ridge[1:], ridge[1:] * MIRROR, ridge[:-1] * MIRROR], axis=1)
    caps, cap_table = _bumpers(section, length, paint, trim)
    floor = np.array([[1, 1], [-1, 1], [-1, -1], [1, -1]]) * (0.45 * length, 0.45 * width)
    underside = np.column_stack([floor, np.full(4, clearance + 0.08)])
    corners = [left.reshape(-1, 4, 3), (left * MIRROR).reshape(-1, 4, 3), lid, caps, underside[None]]
    surfaces = [table[:, :4].reshape(-1, 3)] * 2 + [table[:, 4], cap_table, trim.row[None]]
    parts = [quads(np.concatenate(corners), np.concatenate(surfaces))]
    parts.append(wheels((0.5 - wheel_x) * length, width / 2 - 0.03, wheel_radius, rng))
    parts.append(_details(rng, length, width, height, profile, paint))
    return Primitives.join(parts)


def _bumpers(section: Floats, length: float, paint: Surface, trim: Surface) -> tuple[Floats, Floats]:
    """Front and rear of a body: corners (26,4,3) and surfaces (26,3), bowed from the end sections (5,3) outwards."""
    corners, table = [], []
    for outline, x in ((section[0], length / 2), (section[-1], -length / 2)):
        inner = outline * (0.0, 0.55, 1.0) + (x, 0.0, 0.0)
        flank = np.stack([outline[:-1], outline[1:], inner[1:], inner[:-1]], axis=1)
        middle = np.stack([inner[:-1], inner[1:], inner[1:] * MIRROR, inner[:-1] * MIRROR], axis=1)
        lip = np.stack([outline[-1], inner[-1], inner[-1] * MIRROR, outline[-1] * MIRROR])
        corners += [flank, flank * MIRROR, middle, lip[None]]
        surface = np.broadcast_to(paint.row, (13, 3)).copy()
        surface[[0, 4, 8]] = trim.row  # the lowest strip
        table.append(surface)
    return np.concatenate(corners), np.concatenate(table)


def wheels(x_m: npt.ArrayLike, half_track_m: float, radius_m: float, rng: np.random.Generator) -> Primitives:
    """A wheel at each x on both sides: tyre tread, and a dark sidewall around a shining rim."""
    rubber = Surface(float(rng.uniform(0.01, 0.05)), 0.5)
    rim = Surface(float(rng.uniform(0.15, 0.7)), 1.0)
    a, b = radius_m * _WHEEL[:-1], radius_m * _WHEEL[1:]
    zero, inward = np.zeros_like(a), np.array([0.0, 0.2, 0.0])
    faces = np.stack(
        [np.stack([a, b, b - inward, a - inward], 1), np.stack([a, b, 0.65 * b, 0.65 * a], 1),
         np.stack([0.65 * a, 0.65 * b, zero, zero], 1)]
    )  # fmt: skip
    table = np.broadcast_to(np.stack([rubber.row, rubber.row, rim.row])[:, None], (3, len(a), 3))
    hubs = np.column_stack([np.atleast_1d(x_m), np.full(np.size(x_m), half_track_m), np.full(np.size(x_m), radius_m)])
    left = faces + hubs[:, None, None, None]  # (wheels,3,12,4,3)
    both = np.stack([left, left * MIRROR])
    return quads(both, np.broadcast_to(table, (*both.shape[:4], 3)))


def _details(
    rng: np.random.Generator, length: float, width: float, height: float, profile: Profile, paint: Surface
) -> Primitives:
    """Plates (they shine), lamps, mirrors, and seats, headrests and sometimes people behind the glass."""
    plate = min(0.45 * height, 0.75)
    rows: list[tuple[float, ...]] = [
        (length / 2 - 0.01, 0, 0.3 * height, 0.03, 0.52, 0.11, 0, 0.95, 0.3, 0),
        (-length / 2 + 0.01, 0, plate - 0.1, 0.03, 0.52, 0.11, 0, 0.95, 0.3, 0),
    ]
    for sign in (1, -1):
        rows.append((-length / 2 + 0.03, sign * width * 0.39, 0.5 * height, 0.05, 0.16, 0.14, 0, 0.7, 0.6, 0))
        rows.append((length / 2 - 0.10, sign * width * 0.37, 0.42 * height, 0.08, 0.22, 0.12, 0, 0.5, 1.0, 0))
        mirror = (0.5 - profile.cabin[0] - 0.02) * length
        rows.append((mirror, sign * (width / 2 - 0.02), profile.belt * height, 0.12, 0.14, 0.14, 0,
                     paint.reflectance, paint.gloss, 0))  # fmt: skip
    seats, radii, cloth = [], [], []
    dark = float(np.exp(rng.uniform(np.log(0.005), np.log(0.12))))  # seen through glass twice
    cabin = [length * (0.5 - share) for share in (profile.cabin[0] + 0.18, profile.cabin[0] + 0.42)]
    for x in cabin:
        for y in (0.37, -0.37):
            seats.append((x - 0.1, y * width / 1.65, 0.52 * height))
            radii.append((0.10, 0.24, 0.27))
            cloth.append((dark, 0.3, 0.0))
            seats.append((x - 0.14, y * width / 1.65, 0.74 * height))
            radii.append((0.06, 0.13, 0.10))
            cloth.append((dark, 0.3, 0.0))
    if rng.random() < 0.4:
        x = cabin[0]
        seats += [(x + 0.05, 0.37 * width / 1.65, 0.58 * height), (x + 0.05, 0.37 * width / 1.65, 0.82 * height)]
        radii += [(0.14, 0.22, 0.28), (0.10, 0.08, 0.12)]
        cloth += [(0.12, 0.3, 0.0), (0.12, 0.3, 0.0)]
    rows.append(
        (length * (0.46 - profile.cabin[0]), 0, 0.45 * height, 0.4, 0.8 * width, 0.14 * height, 0, 0.05, 0.5, 0)
    )
    return Primitives.join([cuboids(rows), ellipsoids(seats, radii, np.array(cloth))])


def truck_body(rng: np.random.Generator, length: float, width: float, height: float) -> Primitives:
    """A lorry: cab, gap, box or flat bed on axles."""
    paint, box = draw_paint(rng, 0.35), draw_paint(rng, 0.2)
    cab = float(rng.uniform(1.7, 2.3))
    cab_height = min(height, float(rng.uniform(2.5, 3.2)))
    gap = float(rng.uniform(0.2, 0.6))
    bed = float(rng.uniform(0.9, 1.2))
    load = height - bed if rng.random() < 0.8 else float(rng.uniform(0.4, 0.8))
    front = length / 2 - cab / 2
    pane = float(rng.uniform(0.6, 0.95))
    body = (length - cab - gap, -cab / 2 - gap / 2)
    rows = [
        (front, 0, 0.45, cab, width * 0.96, cab_height * 0.5 - 0.45, 0, *paint.row),
        (front - 0.05, 0, cab_height * 0.5, cab - 0.1, width * 0.94, cab_height * 0.32, 0, 0.2, 4.0, pane),
        (front - 0.05, 0, cab_height * 0.82, cab - 0.1, width * 0.94, cab_height * 0.18, 0, *paint.row),
        (front - 0.6, 0, cab_height * 0.4, 0.4, width * 0.85, cab_height * 0.4, 0, 0.1, 0.4, 0),
        (body[1], 0, bed, body[0], width, load, 0, box.reflectance, min(box.gloss, 1.2), 0),
        (0, 0, 0.7, length - 0.3, 0.9, bed - 0.7, 0, 0.05, 0.5, 0),
    ]  # fmt: skip
    axles = [length / 2 - 1.3, -length / 2 + 1.6, -length / 2 + 2.9 if length > 9 else -length / 2 + 1.6]
    return Primitives.join([cuboids(rows), wheels(np.unique(axles), width / 2 - 0.05, 0.48, rng)])


def bus_body(rng: np.random.Generator, length: float, width: float, height: float, rail: bool = False) -> Primitives:
    """A bus or, on rails, a tram: skirt, band of windows, roof, seats inside."""
    paint = draw_paint(rng, 0.25)
    low = 0.25 if rail else 0.32
    waist, lintel = 0.42 * height, 0.80 * height
    pane = float(rng.uniform(0.5, 0.9))
    rows: list[tuple[float, ...]] = [
        (0, 0, low, length, width, waist - low, 0, paint.reflectance, paint.gloss, 0),
        (0, 0, waist, length - 0.06, width - 0.06, lintel - waist, 0, 0.15, 4.0, pane),
        (0, 0, lintel, length, width, height - lintel, 0, paint.reflectance, paint.gloss, 0),
    ]  # fmt: skip
    for x in np.arange(-length / 2 + 0.1, length / 2 - 0.8, 1.5):
        for sign in (1, -1):
            rows.append((x, sign * (width / 2 - 0.02), waist, 0.12, 0.06, lintel - waist, 0, paint.reflectance, 1.0, 0))
            rows.append((x + 0.7, sign * width * 0.3, waist - 0.2, 0.15, 0.9, 0.75, 0, 0.2, 0.4, 0))
    parts = [cuboids(rows)]
    if not rail:
        parts.append(wheels([length / 2 - 2.6, -length / 2 + 3.0], width / 2 - 0.02, 0.48, rng))
    return Primitives.join(parts)


def trailer_body(rng: np.random.Generator, length: float, width: float, height: float) -> Primitives:
    """What KITTI calls Misc: a trailer, a caravan or a container."""
    paint = draw_paint(rng, 0.2)
    foot = min(0.4, 0.3 * height)
    rows = [
        (0.05 * length, 0, foot, 0.9 * length, width, height - foot, 0, paint.reflectance, min(paint.gloss, 1.0), 0),
        (length * 0.45, 0, foot, length * 0.1, 0.1, 0.1, 0, 0.1, 0.5, 0),
    ]  # fmt: skip
    rows[0] = (-0.05 * length, *rows[0][1:])
    return Primitives.join([cuboids(rows), wheels([-0.1 * length], width / 2, min(0.3, foot + 0.1), rng)])
