"""Pedestrians with what they carry, push and pull, sitting people, bicycles with and without riders, motorcycles.

People consist of ellipsoids with jointed limbs; x forward, feet or wheels on z = 0.
"""

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from asca_pillars.geometry.boxes import Floats
from asca_pillars.sim.bodies.primitives import (
    Limb,
    Primitives,
    Surface,
    cuboids,
    draw_cloth,
    draw_skin,
    ellipsoids,
    jointed,
    limbs,
    prisms,
    quads,
    rotated,
)
from asca_pillars.sim.bodies.vehicles import wheels

# Fractions of people with each, in order; the others carry nothing.
SHARES = {
    "rucksack": 0.26,
    "bag": 0.18,
    "hip_bag": 0.08,
    "suitcase": 0.03,
    "pram": 0.04,
    "bicycle": 0.04,
    "umbrella": 0.03,
}
_WALKER_M = 1.5  # smaller people, children, push nothing


def draw_burden(rng: np.random.Generator, height: float, lean_m: float, shoulder_m: float) -> Primitives:
    """Return an object that a person of that height carries, pulls or pushes; often nothing."""
    names = (*SHARES, "nothing")
    what = names[int(np.searchsorted(np.cumsum(list(SHARES.values())), rng.random()))]
    side = float(rng.choice([-1.0, 1.0]))
    cloth = draw_cloth(rng, 1)
    if what == "rucksack":
        size = (rng.uniform(0.10, 0.16), rng.uniform(0.14, 0.19), rng.uniform(0.12, 0.17) * height)
        return ellipsoids([(lean_m - 0.21, 0, 0.70 * height)], [size], cloth)
    if what == "bag":
        place = (rng.normal(0, 0.05), side * (shoulder_m + 0.06), 0.36 * height)
        return ellipsoids([place], [(0.18, 0.08, 0.15)], cloth)
    if what == "hip_bag":
        return ellipsoids([(-0.02, side * 0.2, 0.53 * height)], [(0.17, 0.08, 0.13)], cloth)
    if what == "suitcase":
        return cuboids([(-0.5, side * 0.2, 0.05, 0.25, 0.4, 0.6, 0.0, *cloth[0, :2], 0.0)])
    if what == "umbrella":
        return _umbrella(rng, height, lean_m, side, cloth)
    if what == "pram" and height > _WALKER_M:
        return _pram(cloth)
    if what == "bicycle" and height > _WALKER_M:
        return bicycle(rng, float(rng.uniform(1.5, 1.8))).placed(float(rng.uniform(0.0, 0.3)), side * 0.42, 0.0, 0.0)
    return Primitives.join([])


def _pram(cloth: np.ndarray) -> Primitives:
    """Return a pram: tub, hood and wheels."""
    tub = ellipsoids(
        [(0.75, 0, 0.72), (0.58, 0, 0.88)], [(0.38, 0.22, 0.17), (0.16, 0.22, 0.17)], np.repeat(cloth, 2, axis=0)
    )
    wheels = [(x, y, 0.0, 0.2, 0.04, 0.22, 0.0, 0.1, 0.3, 0.4) for x in (0.5, 1.0) for y in (0.24, -0.24)]
    return Primitives.join([tub, cuboids(wheels)])


def _umbrella(rng: np.random.Generator, height: float, lean_m: float, side: float, cloth: np.ndarray) -> Primitives:
    """Return an open umbrella over the head, a flat cap on a stick. It exceeds the label's box, as in KITTI."""
    top, radius = height + float(rng.uniform(0.0, 0.1)), float(rng.uniform(0.35, 0.45))
    place = (lean_m + 0.05, side * 0.05, top - 0.1)
    stick = prisms([(place[0], place[1], 0.6 * height, top - 0.6 * height, 0.02, 0.02, 0.2)], sides=4)
    return Primitives.join([ellipsoids([place], [(radius, radius, 0.1)], cloth), stick])


def pedestrian_body(
    rng: np.random.Generator, height: float, width: float, length: float, walked_m: float = 0.0
) -> Primitives:
    """Return a standing or walking person. `width` bounds the shoulders and arms, `length` the step and the swing.

    Only the step depends on `walked_m`: the same `rng` gives the same person.
    """
    h = height
    shoulder = float(np.clip(0.40 * width + 0.04, 0.19, 0.30)) * min(h / 1.6, 1.0)
    lean = float(rng.normal(0.03, 0.025)) * h  # forward, as when walking
    upper, lower, shoe = draw_cloth(rng, 3)
    skin = draw_skin(rng)
    thick = float(rng.uniform(1.35, 1.8))
    # A label box covers all the poses of a walk: in a single scan the feet are between together and far apart.
    stride = float(np.clip(length / 2 - 0.07, 0.06, 0.58)) * (1.0 if rng.random() < 0.88 else 0.2)
    # Feet rest on the ground where the step is widest: half of the walkers are near that phase.
    phase = float(rng.uniform(0.0, 2 * np.pi) if rng.random() < 0.5 else rng.normal(np.pi / 2, 0.5))
    phase += np.pi * walked_m / (2 * stride)  # a foot on the ground stays there while the body passes over it
    rows: list[Limb] = [
        ((0, 0, 0.52 * h), (lean, 0, 0.80 * h), shoulder * 0.9, 0.128 * thick, upper),
        ((lean * 0.8, 0, 0.70 * h), (lean, 0, 0.84 * h), shoulder, 0.115 * thick, upper),
        ((-0.03, 0, 0.46 * h), (-0.03, 0, 0.56 * h), 0.16 * thick, 0.125 * thick, lower),
        ((lean, 0, 0.82 * h), (lean + 0.03, 0, 0.86 * h), 0.055, 0.06, skin),
    ]
    for side in (1.0, -1.0):
        rows += _leg(h, side, stride, phase, thick, (lower, shoe))
        rows += _arm(rng, h, side, -0.75 * stride * np.sin(phase) * side, (lean, shoulder), (upper, skin))
    size = 0.066 if h > 1.4 else 0.076  # children have larger heads
    head = [(lean + 0.055, 0, (1.0 - size) * h), (lean + 0.025, 0, (1.0 - 0.92 * size) * h)]
    hair = draw_cloth(rng, 1)[0] * (0.6, 1.0, 1.0)
    parts = [
        jointed(rows),
        ellipsoids(head, [(0.108, 0.088, size * h), (0.112, 0.098, 0.9 * size * h)], np.stack([skin, hair])),
    ]
    dress = rng.random()
    if dress < 0.2:  # a skirt
        skirt = (0.14 + 0.3 * stride, 0.19, rng.uniform(0.16, 0.26) * h)
        parts.append(ellipsoids([(0, 0, 0.45 * h)], [skirt], lower[None]))
    elif dress < 0.55:  # a coat or a wide jacket
        coat = (0.15 * thick + 0.1 * stride, 0.95 * shoulder + 0.03, rng.uniform(0.24, 0.32) * h)
        parts.append(ellipsoids([(0.3 * lean, 0, 0.58 * h)], [coat], upper[None]))
    parts.append(draw_burden(rng, h, lean, shoulder))
    return Primitives.join(parts)


def _leg(h: float, side: float, stride: float, phase: float, thick: float, cloth: tuple[Floats, Floats]) -> list[Limb]:
    """Return thigh, shin and shoe of a walker; the leg that swings forward is bent and off the ground."""
    lower, shoe = cloth
    forward = stride * np.sin(phase) * side
    lift = 0.5 * min(stride, 0.3) * max(np.cos(phase) * side, 0.0)
    foot = (forward - 0.3 * lift, side * 0.09, 0.05 + lift)
    knee = (0.52 * forward + 0.03 + 0.06 * (forward > 0) + 0.6 * lift, side * 0.10, 0.28 * h + 0.35 * lift)
    heel = 0.25 * max(-forward - 0.06, 0.0)  # the foot behind stands on its toes, the one ahead on its sole
    return [
        ((0, side * 0.09, 0.52 * h), knee, 0.078 * thick, 0.088 * thick, lower),
        (knee, foot, 0.056 * thick, 0.062 * thick, lower),
        (
            (foot[0] - 0.06, foot[1], foot[2] - 0.01 + heel),
            (foot[0] + 0.18, side * 0.11, foot[2] - 0.015),
            0.055,
            0.055,
            shoe,
        ),
    ]


def _arm(
    rng: np.random.Generator,
    h: float,
    side: float,
    swing: float,
    trunk: tuple[float, float],
    cloth: tuple[Floats, Floats],
) -> list[Limb]:
    """Return upper arm and forearm: swinging, or bent to hold, point or telephone. `trunk`: lean, shoulder."""
    lean, shoulder = trunk
    upper, skin = cloth
    swing += float(rng.normal(0.0, 0.04))
    habit = rng.random()
    bent = rng.uniform(0.04, 0.24) if habit < 0.7 else rng.uniform(0.2, 0.35)
    elbow = (lean + 0.45 * swing - 0.02, side * (shoulder + 0.05), 0.63 * h)
    inward = 0.4 * bent * (bent > 0.2)
    hand = (elbow[0] + 0.4 * swing + bent, side * (shoulder + 0.03 - inward), 0.50 * h + 0.5 * bent)
    if habit > 0.95:  # at the ear
        hand = (lean + 0.08, side * 0.12, 0.88 * h)
    return [
        ((lean, side * (shoulder + 0.02), 0.81 * h), elbow, 0.07, 0.075, upper),
        (elbow, hand, 0.053, 0.056, upper if rng.random() < 0.7 else skin),
    ]


def sitting_body(rng: np.random.Generator, height: float) -> Primitives:
    """Return a person on a chair or a bench; `height` is that of the head above the ground."""
    h = height
    upper, lower = draw_cloth(rng, 2)
    seat = 0.36 * h
    rows: list[Limb] = [((-0.1, 0, seat), (-0.14, 0, 0.78 * h), 0.19, 0.12, upper)]
    for side in (0.11, -0.11):
        rows += [
            ((-0.1, side, seat + 0.03), (0.32, side * 1.3, seat + 0.05), 0.08, 0.08, lower),
            ((0.32, side * 1.3, seat + 0.04), (0.34, side * 1.2, 0.06), 0.06, 0.06, lower),
            ((0.28, side * 1.2, 0.05), (0.48, side * 1.3, 0.04), 0.045, 0.04, lower),
            ((-0.12, side * 1.9, 0.76 * h), (0.02, side * 2.1, 0.55 * h), 0.05, 0.05, upper),
            ((0.02, side * 2.1, 0.55 * h), (0.25, side * 1.2, 0.52 * h), 0.04, 0.04, upper),
        ]
    head = ellipsoids([(-0.1, 0, 0.91 * h)], [(0.10, 0.08, 0.09 * h)], np.array([[0.4, 0.2, 0.0]]))
    chair = Surface(0.2, 0.3)
    boards = quads(
        [
            [
                (-0.3, 0.24, seat - 0.05),
                (0.2, 0.24, seat - 0.05),
                (0.2, -0.24, seat - 0.05),
                (-0.3, -0.24, seat - 0.05),
            ],
            [(-0.3, 0.24, seat), (-0.34, 0.24, 0.65 * h), (-0.34, -0.24, 0.65 * h), (-0.3, -0.24, seat)],
        ],
        chair,
    )
    return Primitives.join([jointed(rows), head, boards])


_SEGMENTS = 12  # of a wheel's circle
_RIM = 0.70  # inner over outer radius of tire and rim together
MUDGUARD_SHARE, RACK_SHARE, REFLECTOR_SHARE = 0.8, 0.7, 0.8
STRIPED_TIRE_SHARE, VEST_SHARE = 0.25, 0.1  # with a ring of foil on the sidewalls; riders with foil on their jacket
REFLECTOR = Surface(2.5, 0.5)  # retroreflective


def _circle() -> Floats:
    """Return quadrilaterals (segments,4,3) from each point of the unit circle to the next and back."""
    angle = np.linspace(0, 2 * np.pi, _SEGMENTS + 1)
    ring = np.stack([np.cos(angle), np.zeros_like(angle), np.sin(angle)], axis=1)
    a, b = ring[:-1], ring[1:]
    return np.stack([a, b, b, a], 1)


_CIRCLE = _circle()
# Distances of the corners of tread, tire side and spokes from the hub, as fractions of the radius, and sideways.
_SHARE_OF_RADIUS = np.array([[1.0, 1.0, 1.0, 1.0], [1.0, 1.0, _RIM, _RIM], [_RIM, _RIM, 0.0, 0.0]])[:, None, :, None]
_ASIDE = np.zeros((3, 1, 4, 3))
_ASIDE[0, 0, :, 1] = 0.035, 0.035, -0.035, -0.035


class _Frame(NamedTuple):
    """Joints of a bicycle's frame, metres."""

    wheel_radius: float
    hub_x: float  # of the front wheel; the rear one mirrors it
    head: tuple[float, float, float]
    crank: tuple[float, float, float]
    post: tuple[float, float, float]  # below the saddle


def _frame(length: float) -> _Frame:
    radius = float(np.clip(0.19 * length, 0.26, 0.35))
    hub_x = length / 2 - radius
    return _Frame(radius, hub_x, (hub_x - 0.22, 0.0, 0.80), (-0.08, 0.0, 0.30), (-0.26, 0.0, 0.80))


def bicycle(rng: np.random.Generator, length: float, footprint_m: float = 0.0) -> Primitives:
    """Return a bicycle: wheels, frame, handlebar, saddle; mostly mudguards, a rack, lamps and reflectors.

    Its parts are enlarged by `footprint_m`, the width of a laser's beam there.
    """
    frame = _frame(length)
    paint = float(np.exp(rng.uniform(np.log(0.03), np.log(0.5))))
    parts = [_wheels(rng, frame), _tubes(rng, frame, paint)]
    rows: list[tuple[float, ...]] = []
    if rng.random() < RACK_SHARE:
        rows.append((-frame.hub_x - 0.02, 0, 2 * frame.wheel_radius + 0.06, 0.42, 0.13, 0.04, 0, paint, 0.4, 0))
    if rng.random() < MUDGUARD_SHARE:  # and a chain guard
        rows.append((-0.5 * frame.hub_x, -0.05, 0.24, 0.9 * frame.hub_x, 0.03, 0.13, 0, paint, 0.4, 0))
        parts.append(_mudguards(frame, Surface(float(np.exp(rng.uniform(np.log(0.05), np.log(0.6)))), 0.4)))
    if rng.random() < REFLECTOR_SHARE:
        lamps = ((frame.hub_x - 0.1, 0.78), (-frame.hub_x - frame.wheel_radius + 0.04, 0.62))
        more = footprint_m
        rows += [(x, 0, z - more / 2, 0.04 + more, 0.05 + more, 0.05 + more, 0, *REFLECTOR.row) for x, z in lamps]
        rows += [
            (
                hub + 0.6 * frame.wheel_radius * np.cos(turn),
                0,
                frame.wheel_radius * (1 + 0.6 * np.sin(turn)) - 0.03,
                0.03 + more,
                0.03,
                0.03 + more,
                0,
                *REFLECTOR.row,
            )
            for hub in (frame.hub_x, -frame.hub_x)
            for turn in rng.uniform(0, 2 * np.pi, 2)
        ]
    saddle = ellipsoids([(frame.post[0] - 0.05, 0, 0.96)], [(0.15, 0.09, 0.06)], np.array([[0.15, 0.3, 0.0]]))
    return Primitives.join([*parts, cuboids(rows), saddle])


def _wheels(rng: np.random.Generator, frame: _Frame) -> Primitives:
    """Return tires with their rims, and spokes as mostly transparent disks."""
    rubber = Surface(float(np.exp(rng.uniform(np.log(0.04), np.log(0.3)))), 0.3)
    sidewall = Surface(float(rng.uniform(0.45, 0.95)), 0.3) if rng.random() < STRIPED_TIRE_SHARE else rubber
    spokes = Surface(float(rng.uniform(0.05, 0.3)), 0.2, float(rng.uniform(0.5, 0.75)))
    faces = frame.wheel_radius * _CIRCLE * _SHARE_OF_RADIUS + _ASIDE
    hubs = np.array([[frame.hub_x, 0.0, frame.wheel_radius], [-frame.hub_x, 0.0, frame.wheel_radius]])
    corners = faces + hubs[:, None, None, None]
    table = np.stack([rubber.row, sidewall.row, spokes.row])[None, :, None]
    return quads(corners, np.broadcast_to(table, (*corners.shape[:3], 3)))


def _mudguards(frame: _Frame, surface: Surface) -> Primitives:
    """Return strips above the rear halves of both wheels."""
    angle = np.deg2rad(np.linspace(40.0, 190.0, 6))
    arc = (frame.wheel_radius + 0.02) * np.stack([np.cos(angle), np.zeros_like(angle), np.sin(angle)], axis=1)
    side = np.array([0.0, 0.045, 0.0])
    drop = np.array([[0.95, 1.0, 0.95]])  # they bend down at their sides, where rays from the side hit them
    left, right = arc + side, arc - side
    edges = ((left, right), (left, arc * drop + side), (right, arc * drop - side))
    faces = np.concatenate([np.stack([one[:-1], one[1:], other[1:], other[:-1]], 1) for one, other in edges])
    hubs = np.array([[frame.hub_x, 0.0, frame.wheel_radius], [-frame.hub_x, 0.0, frame.wheel_radius]])
    return quads(faces + hubs[:, None, None], surface)


def _tubes(rng: np.random.Generator, frame: _Frame, paint: float) -> Primitives:
    """Return frame and handlebar."""
    head, crank, post, radius = frame.head, frame.crank, frame.post, frame.wheel_radius
    rear, front = (-frame.hub_x, 0.0, radius), (frame.hub_x, 0.0, radius)
    bar = head[0] - 0.06
    tubes = [
        (head, crank),
        (post, crank),
        (head, post),
        (post, rear),
        (crank, rear),
        (head, front),
        (head, (bar, 0, 1.02)),
        (post, (post[0] - 0.04, 0, 0.95)),
        ((bar, 0.29, 1.03), (bar, -0.29, 1.03)),
    ]
    radii = np.full((len(tubes), 2), float(rng.uniform(0.034, 0.05)))
    surface = np.tile([paint, 0.4, 0.0], (len(tubes), 1))
    return limbs([t[0] for t in tubes], [t[1] for t in tubes], radii, surface, (0.0, 1.0, 0.0))


def cyclist_body(
    rng: np.random.Generator, height: float, width: float, length: float, footprint_m: float = 0.0
) -> Primitives:
    """Return a bicycle and its rider, upright to bent over.

    `height` is that of the head above the ground, `footprint_m` as for `bicycle`.
    """
    neck = np.array([-0.28 + rng.uniform(0.05, 0.42), 0.0, height - 0.27])
    crown = draw_cloth(rng, 1)[0]  # hair or a helmet
    head = ellipsoids(
        [(neck[0] + 0.06, 0, height - 0.13), (neck[0] + 0.03, 0, height - 0.115)],
        [(0.12, 0.09, 0.125), (0.13, 0.10, 0.115)],
        np.stack([draw_skin(rng), crown]),
    )
    return Primitives.join(
        [
            bicycle(rng, length, footprint_m),
            _rider(rng, neck, width, _frame(length).hub_x - 0.28),
            head,
            _luggage(rng, neck, length),
        ]
    )


def _rider(rng: np.random.Generator, neck: Floats, width: float, bar_x: float) -> Primitives:
    """Return trunk, arms and legs between saddle, pedals and handlebar."""
    upper, lower, shoe = draw_cloth(rng, 3, dark_share=0.25)
    bulk = float(rng.uniform(1.2, 1.55))
    shoulder = float(np.clip(0.36 * width, 0.17, 0.26))
    hips = np.array([-0.28, 0.0, 0.99])
    pedal = rng.uniform(0, 2 * np.pi)
    grip = float(np.clip(0.45 * width, 0.2, 0.29))
    rows: list[Limb] = [
        (_offset(hips, 0, 0, -0.05), _offset(neck, 0, 0, -0.04), shoulder, 0.125 * bulk, upper),
        (_offset(hips, -0.02, 0, -0.06), _offset(hips, 0.06, 0, 0.08), 0.16 * bulk, 0.13 * bulk, lower),
    ]
    if rng.random() < VEST_SHARE:
        foil = np.array([rng.uniform(0.5, 1.1), 0.3, 0.0])
        middle = 0.5 * (hips + neck)
        rows.append((_offset(middle, 0, 0, -0.06), _offset(middle, 0.02, 0, 0.08), 1.04 * shoulder, 0.14 * bulk, foil))
    if rng.random() < 0.4:  # a jacket that hangs over the hips
        rows.append((_offset(hips, -0.06, 0, -0.12), 0.5 * (hips + neck), 0.19 * bulk, 0.15 * bulk, upper))
    for side in (1.0, -1.0):
        turn = pedal + (np.pi if side > 0 else 0.0)
        foot = np.array([-0.08 + 0.17 * np.cos(turn), side * 0.11, 0.30 + 0.17 * np.sin(turn)])
        middle = 0.5 * (hips + foot)
        knee = np.array([middle[0] + 0.24, side * 0.13, middle[2] + 0.08])
        hand = np.array([bar_x, side * grip, 1.05])
        elbow = _offset(0.5 * (neck + hand), -0.04, side * 0.10, -0.06)
        rows += [
            (_offset(hips, 0, side * 0.09, 0), knee, 0.08 * bulk, 0.088 * bulk, lower),
            (knee, foot, 0.058 * bulk, 0.064 * bulk, lower),
            (_offset(foot, -0.09, 0, 0), _offset(foot, 0.16, 0, 0), 0.055, 0.055, shoe),
            (_offset(neck, 0, side * shoulder, -0.05), elbow, 0.052 * bulk, 0.055 * bulk, upper),
            (elbow, hand, 0.043 * bulk, 0.043 * bulk, upper),
        ]
    return jointed(rows)


def _offset(joint: Floats, along: float, sideways: float, up: float) -> Floats:
    return joint + np.array([along, sideways, up])


def _luggage(rng: np.random.Generator, neck: Floats, length: float) -> Primitives:
    """Return a rucksack, panniers, a basket, a child behind the saddle, or nothing."""
    what = rng.random()
    if what < 0.26:
        return ellipsoids([(neck[0] - 0.24, 0, neck[2] - 0.2)], [(0.13, 0.16, 0.22)], draw_cloth(rng, 1))
    if what < 0.48:
        bag = np.repeat(draw_cloth(rng, 1), 2, axis=0)
        return ellipsoids([(-0.55, y, 0.55) for y in (0.17, -0.17)], [(0.20, 0.10, 0.20)] * 2, bag)
    if what < 0.60:
        return cuboids([(length / 2 - 0.45, 0, 0.8, 0.28, 0.36, 0.26, 0, 0.3, 0.3, 0.4)])
    if what < 0.66:
        seat = [(-0.56, 0, 0.92), (-0.58, 0, 1.26)]
        return ellipsoids(seat, [(0.15, 0.16, 0.26), (0.10, 0.09, 0.12)], draw_cloth(rng, 2))
    return Primitives.join([])


def parked_bicycle_body(rng: np.random.Generator) -> Primitives:
    """Return a bicycle of random size on its stand or against a wall, sometimes with a basket or panniers."""
    parts = [bicycle(rng, float(rng.uniform(1.45, 1.9)))]
    if rng.random() < 0.25:
        parts.append(cuboids([(rng.choice([-0.62, 0.55]), 0, 0.75, 0.3, 0.32, 0.25, 0, 0.25, 0.3, 0.4)]))
    return _leaning(Primitives.join(parts), float(rng.choice([-1.0, 1.0])) * rng.uniform(0.05, 0.3))


def motorbike_body(rng: np.random.Generator) -> Primitives:
    """Return a motorcycle or a scooter on its stand."""
    return _leaning(_motorbike(rng, float(rng.uniform(1.7, 2.2))), float(rng.uniform(-0.25, 0.25)))


def motorcyclist_body(rng: np.random.Generator, height: float, length: float) -> Primitives:
    """Return a motorcycle or a scooter and its rider, whose helmet is `height` above the ground; KITTI's Misc."""
    jacket, trousers = np.column_stack([rng.uniform(0.02, 0.5, 2), rng.uniform(0.05, 0.4, 2), np.zeros(2)])
    across = np.array([0.0, 0.1, 0.0])
    hips, neck = np.array([-0.25, 0.0, 0.86]), np.array([0.0, 0.0, height - 0.27])
    start, end, radii, surface = [hips], [neck], [(0.2, 0.13)], [jacket]
    for side in (1.0, -1.0):
        knee, foot = np.array([0.2, side * 0.24, 0.66]), np.array([-0.05, side * 0.22, 0.28])
        hand = np.array([0.5 * length - 0.6, side * 0.32, 1.0])
        start += [hips + side * across, knee, neck + side * 2 * across - (0, 0, 0.06)]
        end += [knee, foot, hand]
        radii += [(0.085, 0.09), (0.06, 0.065), (0.055, 0.055)]
        surface += [trousers, trousers, jacket]
    rider = limbs(np.array(start), np.array(end), radii, np.array(surface), (0.0, 1.0, 0.0))
    helmet = ellipsoids([(neck[0] + 0.05, 0, height - 0.14)], [(0.15, 0.12, 0.14)], np.array([[0.3, 0.8, 0.0]]))
    return Primitives.join([_motorbike(rng, length), rider, helmet])


def _motorbike(rng: np.random.Generator, length: float) -> Primitives:
    scooter = rng.random() < 0.45
    radius = float(rng.uniform(0.21, 0.26) if scooter else rng.uniform(0.28, 0.33))
    paint = Surface(float(np.exp(rng.uniform(np.log(0.02), np.log(0.6)))), float(rng.uniform(0.3, 1.5))).row
    dark = Surface(0.05, 0.4).row
    front, back = length / 2 - radius, -length / 2 + radius
    blobs = [
        ((0.05, 0, 0.45), (0.38, 0.17, 0.22), dark),  # engine
        ((0.12, 0, 0.78), (0.32, 0.15, 0.13), paint),  # tank
        ((-0.38, 0, 0.80), (0.42, 0.15, 0.09), dark),  # seat
        ((front - 0.16, 0, 0.80), (0.13, 0.14, 0.16), paint),  # lamp and dials
    ]
    if scooter:
        blobs += [((front - 0.22, 0, 0.55), (0.08, 0.2, 0.38), paint), ((-0.4, 0, 0.52), (0.42, 0.18, 0.24), paint)]
    body = ellipsoids([b[0] for b in blobs], [b[1] for b in blobs], np.array([b[2] for b in blobs]))
    bar = cuboids([(front - 0.3, 0, 0.98, 0.05, 0.72, 0.05, 0, *dark)])
    # Each wheel is a thin pair: the two sides of one tire.
    return Primitives.join([body, bar, wheels([front, back], 0.06, radius, rng)])


def _leaning(body: Primitives, angle_rad: float) -> Primitives:
    """Return the body rolled about its x axis."""
    cos, sin = np.cos(angle_rad), np.sin(angle_rad)
    roll = np.array([[1.0, 0.0, 0.0], [0.0, cos, -sin], [0.0, sin, cos]])
    return replace(
        body,
        triangles=rotated(body.triangles, roll),
        centers=body.centers @ roll.T,
        unit_from_world=rotated(body.unit_from_world, roll),
    )
