"""What a laser scanner gets back from one body that stands alone."""

import numpy as np

from asca_pillars.sim.bodies.primitives import Primitives
from asca_pillars.sim.casting.raycast import Bodies, cast
from asca_pillars.sim.lidar import Lidar, draw_firings
from asca_pillars.sim.returns import measure

GROUND_Z_M = -1.73


def view(body: Primitives, distance_m: float, yaw_rad: float, seed: int = 0) -> np.ndarray:
    """Points (N,4) of a body straight ahead in its own frame: x ahead of it, z above the ground; reflectance."""
    placed = body.placed(distance_m, 0.0, GROUND_Z_M, yaw_rad)
    rng = np.random.default_rng(seed)
    firings = draw_firings(Lidar(), rng, camera_only=True)
    triangles, ellipsoids = len(body.triangles), len(body.centers)
    owners = np.zeros(triangles, np.int64), np.zeros(ellipsoids, np.int64)
    bodies = Bodies(placed, owners[0], np.arange(triangles), owners[1], triangles + np.arange(ellipsoids))
    returns = measure(cast(bodies, 1, None, firings, seed), firings, rng)
    points = returns.points.astype(float)
    cos, sin = np.cos(yaw_rad), np.sin(yaw_rad)
    x, y = points[:, 0] - distance_m, points[:, 1]
    return np.column_stack([x * cos + y * sin, y * cos - x * sin, points[:, 2] - GROUND_Z_M, points[:, 3]])
