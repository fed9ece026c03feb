"""Casting of a whole revolution at a whole scene: a spherical z-buffer over (ring, column).

Each triangle or ellipsoid is tested against the firings of its angular window only; there is no acceleration structure,
because every scene is used once. The ground is not meshed: each ray is marched down to its analytic height.
Random numbers (glass, foliage) belong to a firing and a primitive, so that casting fewer columns never changes
the other returns.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from asca_pillars.geometry.arrays import Floats, Ints, Singles
from asca_pillars.sim.bodies.primitives import Primitives
from asca_pillars.sim.casting.ellipsoidcast import cast_ellipsoids
from asca_pillars.sim.casting.groundcast import cast_ground
from asca_pillars.sim.casting.rays import NOTHING, no_hits, rays_of
from asca_pillars.sim.casting.trianglecast import cast_triangles
from asca_pillars.sim.sensor.lidar import Firings
from asca_pillars.sim.world.ground import Ground

__all__ = ["NOTHING", "Bodies", "Hits", "cast"]


class Hits(NamedTuple):
    """First hit of each firing (K rings, C columns)."""

    rho_m: Floats  # (K,C) horizontal distance from the sensor's axis; inf without a hit
    cosine: Singles  # (K,C) of the angle of incidence
    reflectance: Singles  # (K,C) of the material at this incidence
    owner: NDArray[np.int32]  # (K,C) object index, BACKGROUND, GROUND or NOTHING
    alone: Ints  # (objects,) counted firings that would hit the object if it stood alone
    visible: Ints  # (objects,) those that do hit it


class Bodies(NamedTuple):
    """Geometry of a scene: primitives, each with its owner and a salt.

    The owner is an object's index or BACKGROUND; each object's primitives are consecutive. The salt makes a
    primitive's random numbers (glass, foliage) differ from those of the others.
    """

    primitives: Primitives
    tri_owner: Ints  # (T,)
    tri_salt: Ints  # (T,)
    ell_owner: Ints  # (E,)
    ell_salt: Ints  # (E,)


def cast(bodies: Bodies, objects: int, ground: Ground | None, firings: Firings, seed: int) -> Hits:
    """Cast every firing at bodies and ground; `objects` is the number of labelled objects."""
    primitives = bodies.primitives
    rays, nearest = rays_of(firings), no_hits(firings, objects)
    key = np.uint64(seed & 0xFFFFFFFFFFFFFFFF)
    cast_triangles(
        primitives.triangles,
        primitives.triangle_surface,
        bodies.tri_owner,
        bodies.tri_salt,
        rays,
        nearest,
        key,
    )
    cast_ellipsoids(
        primitives.centers,
        primitives.unit_from_world,
        primitives.ellipsoid_surface,
        bodies.ell_owner,
        bodies.ell_salt,
        rays,
        nearest,
        key,
    )
    if ground is not None:
        cast_ground(ground.street, ground.relief, ground.reflectance, ground.z_m, rays, nearest, key)
    seen = nearest.owner[:, firings.counted]
    visible = np.bincount(seen[seen >= 0], minlength=objects).astype(np.int64)
    return Hits(nearest.rho_m, nearest.cosine, nearest.reflectance, nearest.owner, nearest.alone, visible)
