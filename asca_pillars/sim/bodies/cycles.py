"""Parked bicycles and motorcycles, which KITTI does not label, and motorcyclists; x ahead, wheels on z = 0."""

from dataclasses import replace

import numpy as np

from asca_pillars.sim.bodies.bicycles import bicycle
from asca_pillars.sim.bodies.primitives import Primitives, Surface, cuboids, ellipsoids, limbs, rotated
from asca_pillars.sim.bodies.vehicles import wheels


def parked_bicycle_body(rng: np.random.Generator) -> Primitives:
    """A bicycle of a drawn size that leans on its stand or on a wall, sometimes with a basket or panniers."""
    parts = [bicycle(rng, float(rng.uniform(1.45, 1.9)))]
    if rng.random() < 0.25:
        parts.append(cuboids([(rng.choice([-0.62, 0.55]), 0, 0.75, 0.3, 0.32, 0.25, 0, 0.25, 0.3, 0.4)]))
    return _leaning(Primitives.join(parts), float(rng.choice([-1.0, 1.0])) * rng.uniform(0.05, 0.3))


def motorbike_body(rng: np.random.Generator) -> Primitives:
    """A motorcycle or a scooter on its stand."""
    return _leaning(_motorbike(rng, float(rng.uniform(1.7, 2.2))), float(rng.uniform(-0.25, 0.25)))


def motorcyclist_body(rng: np.random.Generator, height: float, length: float) -> Primitives:
    """A motorcycle or a scooter and its rider, whose helmet is `height` above the ground; KITTI's Misc."""
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
    """The body rolled about its x axis."""
    cos, sin = np.cos(angle_rad), np.sin(angle_rad)
    roll = np.array([[1.0, 0.0, 0.0], [0.0, cos, -sin], [0.0, sin, cos]])
    return replace(
        body,
        triangles=rotated(body.triangles, roll),
        centers=body.centers @ roll.T,
        unit_from_world=rotated(body.unit_from_world, roll),
    )
