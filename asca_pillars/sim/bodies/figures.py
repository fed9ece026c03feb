"""What people are made of: cloth and skin, and limbs from joint to joint."""

import numpy as np
import numpy.typing as npt

from asca_pillars.sim.bodies.primitives import Primitives, limbs

Floats = npt.NDArray[np.float64]
# From, to, radius sideways, radius across, surface.
Limb = tuple[npt.ArrayLike, npt.ArrayLike, float, float, Floats]


def draw_cloth(rng: np.random.Generator, n: int, dark_share: float = 0.1) -> Floats:
    """(n,3) surfaces: skin and cloth are bright in the near infrared, whatever their color; some cloth is black."""
    dark = rng.random(n) < dark_share
    value = np.where(dark, rng.uniform(0.003, 0.06, n), rng.uniform(0.12, 0.8, n))
    return np.column_stack([value, rng.uniform(0.05, 0.4, n), np.zeros(n)])


def draw_skin(rng: np.random.Generator) -> Floats:
    """(3,) reflectance, gloss, density of bare skin."""
    return np.array([rng.uniform(0.3, 0.55), 0.2, 0.0])


def jointed(rows: list[Limb]) -> Primitives:
    """Limbs as ellipsoids."""
    starts, ends, sideways, across, surfaces = zip(*rows, strict=True)
    radii = np.column_stack([sideways, across])
    return limbs(np.array(starts), np.array(ends), radii, np.array(surfaces), (0.0, 1.0, 0.0))
