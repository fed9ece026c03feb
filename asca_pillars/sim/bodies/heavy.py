"""Lorries, buses, trams, trailers and caravans: boxes with wheels; x ahead, wheels on z = 0."""

import numpy as np

from asca_pillars.sim.bodies.primitives import Primitives, cuboids
from asca_pillars.sim.bodies.styles import draw_paint
from asca_pillars.sim.bodies.vehicles import wheels


def truck_body(rng: np.random.Generator, length: float, width: float, height: float) -> Primitives:
    """A lorry: cab, gap, box or flat bed on axles."""
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
    """A bus or, on rails, a tram: skirt, band of windows, roof, seats inside."""
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
    """What KITTI calls Misc: a trailer, a caravan or a container."""
    paint = draw_paint(rng, 0.2).upright
    foot = min(0.4, 0.3 * height)
    rows = [
        (0.05 * length, 0, foot, 0.9 * length, width, height - foot, 0, paint.reflectance, min(paint.gloss, 1.0), 0),
        (length * 0.45, 0, foot, length * 0.1, 0.1, 0.1, 0, 0.1, 0.5, 0),
    ]
    rows[0] = (-0.05 * length, *rows[0][1:])
    return Primitives.join([cuboids(rows), wheels([-0.1 * length], width / 2, min(0.3, foot + 0.1), rng)])
