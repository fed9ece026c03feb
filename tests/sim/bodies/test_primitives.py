"""Changed shapes stay smooth, stand on the ground and are the same for the same numbers."""

import numpy as np

from asca_pillars.sim.bodies.people import cyclist_body
from asca_pillars.sim.bodies.primitives import Primitives, darkened, scaled, warped
from asca_pillars.sim.bodies.styles import HATCHBACK
from asca_pillars.sim.bodies.vehicles import car_body


def bodies() -> list[Primitives]:
    rng = np.random.default_rng(0)
    return [car_body(rng, 4.0, 1.7, 1.5, HATCHBACK), cyclist_body(rng, 1.7, 0.6, 1.8)]


def test_a_warp_is_small_smooth_and_leaves_the_feet_on_the_ground() -> None:
    for body in bodies():
        moved = []
        for seed in range(20):
            one, again = (warped(np.random.default_rng(seed), body, 0.06) for _ in range(2))
            np.testing.assert_array_equal(one.triangles, again.triangles)
            away = (one.triangles - body.triangles).reshape(-1, 3)
            points = body.triangles.reshape(-1, 3)
            assert np.abs(away).max() <= 0.06 and np.abs(one.centers - body.centers).max(initial=0.0) <= 0.06
            assert np.abs(away[points[:, 2] < 0.05, 2]).max(initial=0.0) < 0.007
            # Corners that panels share stay together, and neighbors 2 cm apart part by millimetres.
            order = np.lexsort(points.T)
            same = (np.diff(points[order], axis=0) == 0).all(axis=1)
            np.testing.assert_array_equal(np.diff(away[order], axis=0)[same], 0.0)
            moved.append(np.abs(away).max())
        assert np.mean(moved) > 0.015
    body = bodies()[0]
    for seed in range(10):
        before, after = body.triangles, warped(np.random.default_rng(seed), body, 0.06).triangles
        edges = [np.linalg.norm(corners[:, 1] - corners[:, 0], axis=1) for corners in (before, after)]
        long = edges[0] > 0.05
        assert (np.abs(edges[1] / edges[0] - 1)[long] < 0.4).all()
    body = bodies()[0]
    np.testing.assert_array_equal(warped(np.random.default_rng(0), body, 0.0).triangles, body.triangles)


def test_scaling_keeps_surfaces_and_dark_patches_reflect_nothing() -> None:
    body = bodies()[1]
    factors = np.array([1.1, 0.9, 1.02])
    direction = np.array([0.6, 0.0, 0.8])
    points = body.centers + np.linalg.inv(body.unit_from_world) @ direction
    larger = scaled(body, factors)
    unit = np.einsum("nij,nj->ni", larger.unit_from_world, points * factors - larger.centers)
    np.testing.assert_allclose(np.linalg.norm(unit, axis=1), 1.0)
    np.testing.assert_allclose(larger.triangles, body.triangles * factors)
    for body in bodies():
        for seed in range(10):
            dark = darkened(np.random.default_rng(seed), body)
            black = np.concatenate([dark.triangle_surface[:, 0], dark.ellipsoid_surface[:, 0]]) == 0.0
            was_black = np.concatenate([body.triangle_surface[:, 0], body.ellipsoid_surface[:, 0]]) == 0.0
            assert 0 < (black & ~was_black).sum() < 0.8 * len(black) or (black & was_black).any()
            np.testing.assert_array_equal(dark.triangles, body.triangles)
            np.testing.assert_array_equal(dark.triangle_surface[:, 1:], body.triangle_surface[:, 1:])
    nothing = Primitives.join([])
    assert darkened(np.random.default_rng(0), nothing) is nothing
