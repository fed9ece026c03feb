"""Cars and vans as triangle meshes; lorries, buses, trams, trailers and caravans as boxes with wheels.

x forward, wheels on z = 0.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from asca_pillars.geometry.boxes import Floats
from asca_pillars.sim.bodies.primitives import Primitives, Surface, cuboids, ellipsoids, quads
from asca_pillars.sim.bodies.styles import Paint, Profile, draw_paint

MIRROR = np.array([1.0, -1.0, 1.0])
_SPOKES = 10


def _unit_wheel() -> Floats:
    """Return tread (without width), sidewall and rim of a wheel of radius 1: corners (25,4,3), the rim's in pairs."""
    angle = np.linspace(0, 2 * np.pi, _SPOKES + 1)
    ring = np.stack([np.cos(angle), np.zeros(_SPOKES + 1), np.sin(angle)], axis=1)
    a, b = ring[:-1], ring[1:]
    return np.concatenate(
        [
            np.stack([a, b, b, a], 1),
            np.stack([a, b, 0.65 * b, 0.65 * a], 1),
            0.65 * np.stack([a[::2], b[::2], b[1::2], np.zeros_like(a[::2])], 1),
        ]
    )


_WHEEL = _unit_wheel()
GLASS = 0.03  # reflectance of what windows return, mostly too weak for the sensor to report
_LID = ((1.0, 1.0), (0.85, 0.66), (0.45, 0.2), (0.0, 0.0))  # across hood and roof: fraction of half width, of the crown


class _Hull(NamedTuple):
    """Dimensions of one body, metres, and its style."""

    length: float
    width: float
    height: float
    profile: Profile
    clearance: float
    wheel_x: Floats  # (2,) fractions of length
    wheel_radius: float
    crown: float
    rail: float  # height of the frame between a side window and the edge of the roof
    nose_bow: float  # distance by which the corners of the nose stand back
    tail_bow: float


def car_body(
    rng: np.random.Generator,
    length: float,
    width: float,
    height: float,
    profile: Profile,
    dark_share: float = 0.5,
    footprint_m: float = 0.0,
) -> Primitives:
    """Return a lofted car or van with wheels, mirrors, plates and seats behind its glass.

    Plates and lamps are enlarged by `footprint_m`, the width of a laser's beam there: a beam that touches them returns
    brightly.
    """
    hull = _Hull(
        length,
        width,
        height,
        profile,
        clearance=float(rng.uniform(0.12, 0.22)),
        wheel_x=np.array([rng.uniform(0.17, 0.21), rng.uniform(0.78, 0.83)]),
        wheel_radius=float(rng.uniform(0.29, 0.34)) * float(np.clip(1.0 + 0.25 * (height - 1.5), 0.95, 1.2)),
        crown=float(rng.uniform(0.03, 0.07)),
        rail=float(rng.uniform(0.09, 0.18)),
        nose_bow=float(rng.uniform(0.04, 0.20)),
        tail_bow=float(rng.uniform(0.02, 0.09)),
    )
    paint = draw_paint(rng, dark_share)
    trim = Surface(float(np.exp(rng.uniform(np.log(0.008), np.log(0.06)))), 0.5)
    corners, table = _shell(hull, paint, trim, rng)
    corners = np.concatenate([corners, corners * MIRROR])
    floor = np.array([[1, 1], [-1, 1], [-1, -1], [1, -1]]) * (0.45 * length, 0.45 * width)
    underside = np.column_stack([floor, np.full(4, hull.clearance + 0.08)])
    parts = [quads(corners, np.concatenate([table, table])), quads(underside, trim)]
    parts.append(wheels((0.5 - hull.wheel_x) * length, width / 2 - 0.05, hull.wheel_radius, rng))
    parts += [_fittings(rng, hull, paint.upright, footprint_m), _seats(rng, hull)]
    return Primitives.join(parts)


def _sections(hull: _Hull, x: Floats) -> Floats:
    """Return left halves (S,8,3) of the cross-sections at fractions `x` of the length: sill, waist, ..., middle."""
    top = np.array(hull.profile.top)
    z_top = np.interp(x, top[:, 0], top[:, 1]) * hull.height
    arch = hull.wheel_radius + 0.06
    to_wheel = np.abs(x[:, None] - hull.wheel_x).min(axis=1) * hull.length
    sill = np.where(
        to_wheel < arch, hull.wheel_radius + np.sqrt(np.maximum(arch**2 - to_wheel**2, 0.0)), hull.clearance
    )
    edge = z_top - hull.crown
    belt = np.minimum(hull.profile.belt * hull.height, edge - 0.01)
    waist = np.minimum(2 * hull.wheel_radius + 0.09, 0.3 * hull.clearance + 0.7 * belt)
    sill = np.minimum(sill, waist - 0.01)
    # Bodies narrow towards both ends and round their corners; they are widest above the wheels.
    plan = 1.0 - 0.015 * np.maximum(1 - x / 0.25, 0) ** 2 - 0.025 * np.maximum(1 - x / 0.04, 0) ** 2
    plan -= 0.02 * np.maximum(1 - (1 - x) / 0.25, 0) ** 2 + 0.03 * np.maximum(1 - (1 - x) / 0.04, 0) ** 2
    plan *= hull.width / 2
    over_belt = np.clip((z_top - hull.profile.belt * hull.height) / ((1 - hull.profile.belt) * hull.height), 0.0, 1.0)
    roof = plan * (0.94 + (hull.profile.tumble - 0.94) * over_belt)
    lintel = np.maximum(edge - hull.rail, 0.5 * (belt + edge))
    shoulder = 0.98 * plan
    frame = shoulder + (lintel - belt) / (edge - belt) * (roof - shoulder)
    half = np.stack([0.95 * plan, plan, shoulder, frame] + [share * roof for share, _ in _LID], axis=1)
    high = np.stack([sill, waist, belt, lintel] + [z_top - drop * hull.crown for _, drop in _LID], axis=1)
    along = (0.5 - x)[:, None] * hull.length + _bow(hull, x[:, None], half)
    return np.stack([along, half, high], axis=2)


def _bow(hull: _Hull, x: Floats, y_m: Floats) -> Floats:
    """Return the distance by which a section's points at `y_m` are ahead of its middle, metres."""
    outward = (y_m / (hull.width / 2)) ** 2
    return outward * (
        hull.tail_bow * np.maximum(1 - (1 - x) / 0.3, 0) - hull.nose_bow * np.maximum(1 - x / 0.45, 0) ** 1.5
    )


def _shell(hull: _Hull, paint: Paint, trim: Surface, rng: np.random.Generator) -> tuple[Floats, Floats]:
    """Return the left half of a body: corners (Q,4,3) and surfaces (Q,3)."""
    profile, top = hull.profile, np.array(hull.profile.top)
    # A pane reflects specularly the light that it does not transmit: most windows of KITTI's cars are holes.
    pane = Surface(GLASS, 15.0, float(rng.uniform(0.1, 0.7)))
    # Side windows are dirty or tinted, or the outline lacks a frame: half as many returns as from a door.
    window = Surface(GLASS, float(np.exp(rng.uniform(np.log(0.3), np.log(12.0)))), float(rng.uniform(0.05, 0.6)))
    arch = (hull.wheel_radius + 0.06) / hull.length
    arches = (hull.wheel_x[:, None] + np.array([-1.0, -0.8, -0.4, 0.4, 0.8, 1.0]) * arch).ravel()
    low = np.unique(np.concatenate([[0.0, 0.02, 0.05], arches, [0.95, 0.98, 1.0]]).clip(0, 1))
    post = profile.cabin[0] + float(rng.uniform(0.40, 0.50)) * (profile.cabin[1] - profile.cabin[0])
    posts = [post - 0.018, post + 0.018]
    high = np.unique(np.concatenate([top[:, 0], profile.cabin, posts]).clip(0, 1))
    sections = _sections(hull, np.concatenate([low, high]))
    lower, upper = sections[: len(low), :2], sections[len(low) :, 1:]

    middle = (high[:-1] + high[1:]) / 2
    raised = np.interp(middle, top[:, 0], top[:, 1]) > profile.belt + 0.08
    in_window = (middle > profile.cabin[0]) & (middle < profile.cabin[1]) & raised & (np.abs(middle - post) > 0.018)
    # Behind the side windows of vans and pickups there is a painted wall, behind those of cars a pillar.
    framed = raised & ((middle < profile.cabin[1]) | (profile.cabin[1] > 0.7))
    in_pane = np.zeros(len(middle), bool)
    for begin, end in profile.glass:
        in_pane |= (middle > begin) & (middle < end)
    steep = np.abs(np.diff(upper[:, -1, 2])) > 0.6 * np.abs(np.diff(high)) * hull.length
    # Panels from waist to belt, lintel and edge of the roof, over the posts beside the panes, and two to the middle.
    table = np.empty((len(middle), 6, 3))
    table[:, :3] = paint.upright.row
    table[:, 3:] = np.where(steep[:, None, None], paint.upright.row, paint.flat.row)
    table[framed, 1:3] = paint.frame.row
    table[framed & steep, 3:] = paint.frame.row
    table[in_window, 1] = window.row
    table[in_pane, 4:] = pane.row
    skirt = np.broadcast_to(paint.upright.row, (len(low) - 1, 3))
    ends = [_end(hull, x, sections[at]) for x, at in ((0.0, 0), (1.0, -1))]
    bumper = np.tile(np.stack([trim.row, paint.upright.row]), (4, 1))
    return np.concatenate([_panels(lower), _panels(upper), *ends]), np.concatenate(
        [skirt, table.reshape(-1, 3), bumper]
    )


def _panels(grid: Floats) -> Floats:
    """Return quadrilaterals (..., 4, 3) between the neighbors of a grid of points (R,C,3)."""
    return np.stack([grid[:-1, :-1], grid[1:, :-1], grid[1:, 1:], grid[:-1, 1:]], axis=2).reshape(-1, 4, 3)


def _end(hull: _Hull, x: float, outline: Floats) -> Floats:
    """Return the left half of the nose (x = 0) or the tail (x = 1) inside its section (8,3).

    Corners are (4,4,3), low and high alternating.
    """
    levels = outline[[0, 1, 4]]  # sill, waist, edge
    share = np.array([1.0, 0.6, 0.0])[:, None]
    y = share * levels[:, 1]
    z = np.broadcast_to(levels[:, 2], y.shape).copy()
    z[:, 2] += hull.crown * (1 - share[:, 0] ** 2)
    along = (0.5 - x) * hull.length + _bow(hull, np.full_like(y, x), y)
    along[:, 0] -= np.sign(0.5 - x) * 0.04  # bumpers recede towards the road
    return _panels(np.stack([along, y, z], axis=2))


def wheels(x_m: ArrayLike, half_track_m: float, radius_m: float, rng: np.random.Generator) -> Primitives:
    """Return a wheel at each x on both sides: tread, dark sidewall, and a rim of random reflectance."""
    rubber = Surface(float(np.exp(rng.uniform(np.log(0.01), np.log(0.06)))), 0.3)
    rim = Surface(float(np.exp(rng.uniform(np.log(0.05), np.log(0.5)))), 0.6)
    faces = radius_m * _WHEEL
    faces[:_SPOKES, 2:, 1] -= min(0.2, half_track_m)  # the tread reaches inwards
    table = np.repeat(np.stack([rubber.row, rim.row]), (2 * _SPOKES, _SPOKES // 2), axis=0)
    hubs = np.column_stack([np.atleast_1d(x_m), np.full(np.size(x_m), half_track_m), np.full(np.size(x_m), radius_m)])
    left = faces + hubs[:, None, None]  # (wheels,25,4,3) of 10 + 10 + 5 faces
    both = np.stack([left, left * MIRROR])
    return quads(both, np.broadcast_to(table, (*both.shape[:3], 3)))


def _fittings(rng: np.random.Generator, hull: _Hull, paint: Surface, footprint_m: float) -> Primitives:
    """Return plates, lamps and their reflectors, which are bright, mirrors, and the dashboard."""
    length, width, height, profile = hull.length, hull.width, hull.height, hull.profile
    plate_z = min(0.45 * height, 0.75)
    plate = Surface(float(rng.uniform(1.5, 4.0)), 0.3).row
    rear_lamp, front_lamp = (
        Surface(float(rng.uniform(0.5, 1.8)), 0.4).row,
        Surface(float(rng.uniform(0.3, 1.2)), 0.6).row,
    )
    more = footprint_m
    rows: list[tuple[float, ...]] = [
        (length / 2, 0, 0.25 * height, 0.05, 0.52 + more, 0.11 + more, 0, *plate),
        (-length / 2, 0, plate_z - 0.1, 0.05, 0.52 + more, 0.11 + more, 0, *plate),
        (length * (0.46 - profile.cabin[0]), 0, 0.45 * height, 0.4, 0.8 * width, 0.14 * height, 0, 0.05, 0.5, 0),
    ]
    nose, tail = length / 2 - 0.55 * hull.nose_bow, 0.035 - length / 2 + 0.6 * hull.tail_bow
    mirror = (0.5 - profile.glass[0][0] - float(rng.uniform(0.0, 0.05))) * length  # at the foot of the windscreen
    mirror_z = profile.belt * height + float(rng.uniform(-0.03, 0.1))
    stands_out = float(rng.uniform(0.03, 0.08))
    lamp_m = float(rng.uniform(0.08, 0.2))  # height of the rear ones
    for sign in (1, -1):
        rows += [
            (tail, sign * width * 0.40, 0.5 * height, 0.08, 0.10 + more, lamp_m + more, 0, *rear_lamp),
            (tail - 0.03, sign * width * 0.38, 0.24 * height, 0.06, 0.06 + more, 0.03 + more, 0, 2.5, 0.4, 0),
            (nose - 0.02 * length, sign * width * 0.38, 0.38 * height, 0.08, 0.24 + more, 0.11 + more, 0, *front_lamp),
            (mirror, sign * (width / 2 + stands_out), mirror_z, 0.10, 0.17, 0.13, 0, *paint.row),
        ]
    return cuboids(rows)


def _seats(rng: np.random.Generator, hull: _Hull) -> Primitives:
    """Return seats, headrests, and sometimes a driver and a passenger."""
    dark = float(np.exp(rng.uniform(np.log(0.003), np.log(0.06))))  # visible through glass twice
    front = hull.length * (0.5 - hull.profile.cabin[0] - 0.18)
    rows = []
    for x in (front, front - 0.24 * hull.length):
        for side in (0.37, -0.37):
            y = side * hull.width / 1.65
            rows.append((x - 0.1, y, 0.52 * hull.height, 0.10, 0.24, 0.27, dark))
            rows.append((x - 0.14, y, 0.74 * hull.height, 0.06, 0.13, 0.10, dark))
    for side, chance in ((0.37, 0.4), (-0.37, 0.12)):
        if rng.random() < chance:
            y = side * hull.width / 1.65
            rows.append((front + 0.05, y, 0.58 * hull.height, 0.14, 0.22, 0.28, 0.12))
            rows.append((front + 0.05, y, 0.80 * hull.height, 0.10, 0.08, 0.12, 0.12))
    table = np.array(rows)
    surface = np.column_stack([table[:, 6], np.full(len(table), 0.3), np.zeros(len(table))])
    # Hardly any return comes from beyond the front seats, from either end.
    half, top = 0.43 * hull.width, 0.72 * hull.height
    wall = [(front, half, 0.3), (front, -half, 0.3), (front, -half, top), (front, half, top)]
    return Primitives.join([ellipsoids(table[:, :3], table[:, 3:6], surface), quads([wall], Surface(0.0))])


def truck_body(rng: np.random.Generator, length: float, width: float, height: float) -> Primitives:
    """Return a lorry: cab, gap, box or flat bed on axles."""
    paint, box = draw_paint(rng, 0.35).upright, draw_paint(rng, 0.2).upright
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
    ]
    axles = [length / 2 - 1.3, -length / 2 + 1.6, -length / 2 + 2.9 if length > 9 else -length / 2 + 1.6]
    return Primitives.join([cuboids(rows), wheels(np.unique(axles), width / 2 - 0.05, 0.48, rng)])


def bus_body(rng: np.random.Generator, length: float, width: float, height: float, rail: bool = False) -> Primitives:
    """Return a bus or, on rails, a tram: skirt, band of windows, roof, seats inside."""
    paint = draw_paint(rng, 0.25).upright
    low = 0.25 if rail else 0.32
    waist, lintel = 0.42 * height, 0.80 * height
    pane = float(rng.uniform(0.5, 0.9))
    rows: list[tuple[float, ...]] = [
        (0, 0, low, length, width, waist - low, 0, paint.reflectance, paint.gloss, 0),
        (0, 0, waist, length - 0.06, width - 0.06, lintel - waist, 0, 0.15, 4.0, pane),
        (0, 0, lintel, length, width, height - lintel, 0, paint.reflectance, paint.gloss, 0),
    ]
    for x in np.arange(-length / 2 + 0.1, length / 2 - 0.8, 1.5):
        for sign in (1, -1):
            rows.append((x, sign * (width / 2 - 0.02), waist, 0.12, 0.06, lintel - waist, 0, paint.reflectance, 1.0, 0))
            rows.append((x + 0.7, sign * width * 0.3, waist - 0.2, 0.15, 0.9, 0.75, 0, 0.2, 0.4, 0))
    parts = [cuboids(rows)]
    if not rail:
        parts.append(wheels([length / 2 - 2.6, -length / 2 + 3.0], width / 2 - 0.02, 0.48, rng))
    return Primitives.join(parts)


def trailer_body(rng: np.random.Generator, length: float, width: float, height: float) -> Primitives:
    """Return an object of KITTI's type Misc: a trailer, a caravan or a container."""
    paint = draw_paint(rng, 0.2).upright
    foot = min(0.4, 0.3 * height)
    rows = [
        (0.05 * length, 0, foot, 0.9 * length, width, height - foot, 0, paint.reflectance, min(paint.gloss, 1.0), 0),
        (length * 0.45, 0, foot, length * 0.1, 0.1, 0.1, 0, 0.1, 0.5, 0),
    ]
    rows[0] = (-0.05 * length, *rows[0][1:])
    return Primitives.join([cuboids(rows), wheels([-0.1 * length], width / 2, min(0.3, foot + 0.1), rng)])
