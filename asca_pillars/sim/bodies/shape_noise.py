"""Random changes of shape, against overfitting to exact shapes: scale per axis, smooth warps, dark patches."""

from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike

from asca_pillars.geometry.arrays import Floats, Mask
from asca_pillars.sim.bodies.primitives import Primitives

_WAVES = 2
_WAVELENGTH_M = 1.0, 5.0
_FEET_M = 0.5  # displacements fade below it towards the ground
_PATCH_M = 0.15, 0.45


def scaled(body: Primitives, factors: ArrayLike) -> Primitives:
    """Return the body scaled about its origin by `factors` (3,) along x, y and z."""
    by = np.asarray(factors, float)
    return replace(
        body, triangles=body.triangles * by, centers=body.centers * by, unit_from_world=body.unit_from_world / by
    )


def warped(rng: np.random.Generator, body: Primitives, most_m: float) -> Primitives:
    """Return the body with every point displaced by a smooth random field, by at most `most_m` along each axis.

    The field is a sum of a few waves that are longer than a limb and mostly longer than a person. Positions
    are displaced, ellipsoids keep their shape.
    """
    direction = rng.standard_normal((_WAVES, 3))
    length = np.exp(rng.uniform(np.log(_WAVELENGTH_M[0]), np.log(_WAVELENGTH_M[1]), _WAVES))
    number = 2 * np.pi * direction / (np.linalg.norm(direction, axis=1) * length)[:, None]
    phase = rng.uniform(0.0, 2 * np.pi, _WAVES)
    shift = rng.uniform(-most_m / _WAVES, most_m / _WAVES, (_WAVES, 3))

    def moved(points: Floats) -> Floats:
        flat = points.reshape(-1, 3)
        away = np.sin(flat @ number.T + phase) @ shift
        away[:, 2] *= np.minimum(np.abs(flat[:, 2]) / _FEET_M, 1.0)
        away += flat
        return away.reshape(points.shape)

    return replace(body, triangles=moved(body.triangles), centers=moved(body.centers))


def darkened(rng: np.random.Generator, body: Primitives) -> Primitives:
    """Return the body with a patch without returns about a random point of it: black, wet or at grazing incidence."""
    middles = np.concatenate([body.triangles.mean(axis=1), body.centers])
    if not len(middles):
        return body
    around = middles[int(rng.integers(len(middles)))]
    dark = np.linalg.norm(middles - around, axis=1) < rng.uniform(*_PATCH_M)
    first = len(body.triangles)

    def without(surface: Floats, which: Mask) -> Floats:
        surface = surface.copy()
        surface[which, 0] = 0.0
        return surface

    return replace(
        body,
        triangle_surface=without(body.triangle_surface, dark[:first]),
        ellipsoid_surface=without(body.ellipsoid_surface, dark[first:]),
    )
