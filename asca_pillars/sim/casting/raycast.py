"""Casting a whole revolution at a whole scene: a spherical z-buffer over (ring, column).

Each triangle or ellipsoid touches only the firings of its angular window; nothing is built beforehand, because
every scene is used once. The ground is not meshed: each ray walks down to it along its analytic height.
All chance (glass, foliage) belongs to a firing and a primitive, so that casting fewer columns never changes what
the others return.
"""

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from asca_pillars.sim.bodies.primitives import Primitives
from asca_pillars.sim.casting.bodycast import cast_ellipsoids, cast_triangles
from asca_pillars.sim.casting.groundcast import cast_ground
from asca_pillars.sim.sensor.lidar import Firings
from asca_pillars.sim.world.ground import Ground

Floats = npt.NDArray[np.float64]
Singles = npt.NDArray[np.float32]
Ints = npt.NDArray[np.int64]
NOTHING = -3  # owner of a firing that met nothing


class Hits(NamedTuple):
    """What each firing (K rings, C columns) met first."""

    rho_m: Floats  # (K,C) horizontal distance from the sensor's axis; inf for nothing
    cosine: Singles  # (K,C) of the angle of incidence
    reflectance: Singles  # (K,C) of the material at this incidence
    owner: npt.NDArray[np.int32]  # (K,C) object index, BACKGROUND, GROUND or NOTHING
    alone: Ints  # (objects,) firings in the camera's columns that would hit the object if it stood alone
    visible: Ints  # (objects,) those that do hit it


class Bodies(NamedTuple):
    """What is cast at: primitives, each with its owner (object index or BACKGROUND, objects in one run each) and a
    salt, the number that tells its chance (glass, foliage) from that of the others."""

    primitives: Primitives
    tri_owner: Ints  # (T,)
    tri_salt: Ints  # (T,)
    ell_owner: Ints  # (E,)
    ell_salt: Ints  # (E,)


def cast(bodies: Bodies, objects: int, ground: Ground | None, firings: Firings, seed: int) -> Hits:
    """Cast every firing at bodies and ground; `objects` is the number of labelled objects."""
    primitives = bodies.primitives
    rings, columns = len(firings.slope), len(firings.azimuth_rad)
    rho = np.full((rings, columns), np.inf)
    cosine = np.zeros((rings, columns), np.float32)
    reflectance = np.zeros((rings, columns), np.float32)
    owner = np.full((rings, columns), NOTHING, np.int32)
    stamp = np.full((rings, columns), -1, np.int32)
    alone = np.zeros(objects, np.int64)
    sensor = (firings.slope, firings.origin_z_m, firings.phase_rad, np.cos(firings.azimuth_rad),
              np.sin(firings.azimuth_rad), firings.first_column, firings.cast, firings.in_camera)  # fmt: skip
    buffers = (rho, cosine, reflectance, owner, stamp, alone)
    key = np.uint64(seed & 0xFFFFFFFFFFFFFFFF)
    cast_triangles(primitives.triangles, primitives.triangle_surface, bodies.tri_owner, bodies.tri_salt,
                    sensor, buffers, key)  # fmt: skip
    matrices = primitives.unit_from_world
    cast_ellipsoids(primitives.centers, matrices, np.linalg.inv(matrices), primitives.ellipsoid_surface,
                     bodies.ell_owner, bodies.ell_salt, sensor, buffers, key)  # fmt: skip
    if ground is not None:
        grass = np.random.default_rng(seed).random((rings, columns), np.float32)
        cast_ground(ground.street, ground.relief, ground.reflectance, ground.z_m, sensor, buffers, grass)
    seen = owner[:, firings.in_camera]
    visible = np.bincount(seen[seen >= 0], minlength=objects).astype(np.int64)
    return Hits(rho, cosine, reflectance, owner, alone, visible)
