"""The ray caster against Embree, and against arithmetic."""

from dataclasses import replace

import numpy as np
import pytest

from asca_pillars.sim.bodies.primitives import BACKGROUND, Primitives, Surface, cuboids, ellipsoids, prisms, quads
from asca_pillars.sim.bodies.styles import SALOON
from asca_pillars.sim.bodies.vehicles import car_body
from asca_pillars.sim.casting.groundcast import GROUND
from asca_pillars.sim.casting.raycast import NOTHING, Bodies, cast
from asca_pillars.sim.lidar import Firings, Lidar, draw_firings
from asca_pillars.sim.world.ground import Ground, draw_relief, make_street


def bodies(primitives: Primitives, owner: int = BACKGROUND) -> Bodies:
    triangles, blobs = len(primitives.triangles), len(primitives.centers)
    owners = np.full(triangles, owner), np.full(blobs, owner)
    return Bodies(primitives, owners[0], np.arange(triangles), owners[1], triangles + np.arange(blobs))


def directions(firings: Firings) -> np.ndarray:
    """(K,C,3) ray directions of horizontal length 1."""
    azimuth = firings.azimuth_rad[None] + firings.phase_rad[:, None]
    slope = np.broadcast_to(firings.slope[:, None], azimuth.shape)
    return np.stack([np.cos(azimuth), np.sin(azimuth), slope], axis=-1)


@pytest.fixture(scope="module")
def firings() -> Firings:
    return draw_firings(Lidar(), np.random.default_rng(3), camera_only=False)


def opaque_street(seed: int) -> Primitives:
    """Boxes, posts, cars and slivers all around, some across azimuth 0 and 180 degrees, one around the sensor."""
    rng = np.random.default_rng(seed)
    n = 30
    azimuth, distance = rng.uniform(-np.pi, np.pi, n), rng.uniform(4.0, 70.0, n)
    rows = np.zeros((n, 10))
    rows[:, 0], rows[:, 1], rows[:, 2] = distance * np.cos(azimuth), distance * np.sin(azimuth), -1.8
    rows[:, 3:6] = rng.uniform(0.3, 8.0, (n, 3))
    rows[:, 6], rows[:, 7] = rng.uniform(-np.pi, np.pi, n), 0.5
    rows[:, 3:5] = np.minimum(rows[:, 3:5], 0.4 * distance[:, None])
    floor = quads([[(30, 30, -1.9), (-25, 30, -1.9), (-25, -30, -1.9), (30, -30, -1.9)]], Surface(0.3))
    posts = prisms([(12.0, 0.01, -1.8, 4.0, 0.1, 0.1, 0.3), (-9.0, -0.02, -1.8, 4.0, 0.2, 0.1, 0.3)])
    car = car_body(rng, 4.1, 1.7, 1.5, SALOON).placed(14.0, -3.0, -1.8, 0.7)
    car.triangle_surface[:, 2] = 0.0  # Embree knows no chance
    whole = Primitives.join([cuboids(rows), floor, posts, car])
    return Primitives(whole.triangles, whole.triangle_surface, np.zeros((0, 3)), np.zeros((0, 3, 3)), np.zeros((0, 3)))


@pytest.mark.parametrize("seed", [0, 1])
def test_triangles_agree_with_embree(firings: Firings, seed: int) -> None:
    trimesh = pytest.importorskip(
        "trimesh", reason="Embree's answers come through trimesh: pip install trimesh embreex"
    )
    ray = pytest.importorskip("trimesh.ray.ray_pyembree", reason="needs Embree: pip install embreex")
    primitives = opaque_street(seed)
    hits = cast(bodies(primitives), 0, None, firings, seed=1)
    mesh = trimesh.Trimesh(
        primitives.triangles.reshape(-1, 3), np.arange(3 * len(primitives.triangles)).reshape(-1, 3), process=False
    )
    caster = ray.RayMeshIntersector(mesh, scale_to_box=False)
    rays = directions(firings)[:, ::5].reshape(-1, 3)
    origin = np.zeros_like(rays)
    origin[:, 2] = np.repeat(firings.origin_z_m, len(rays) // len(firings.origin_z_m))

    def embree(origin: np.ndarray, rays: np.ndarray) -> np.ndarray:
        """Horizontal distance of the first hit, inf for none. Embree names the triangle; double precision the place."""
        first, met = caster.intersects_id(origin, rays, multiple_hits=False)
        corner = primitives.triangles[first]
        normal = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
        distance = np.full(len(rays), np.inf)
        distance[met] = ((corner[:, 0] - origin[met]) * normal).sum(1) / (rays[met] * normal).sum(1)
        return distance

    got, expected = hits.rho_m[:, ::5].ravel(), embree(origin, rays)
    assert np.isfinite(expected).sum() > 10_000  # the scene fills a good part of the view
    same = np.isclose(got, expected, rtol=0, atol=1e-4) | (np.isinf(got) & np.isinf(expected))
    assert same.mean() > 0.999
    # What is left are rays along edges, which single precision puts on either side: one a hair beside them agrees.
    left, found = np.flatnonzero(~same), np.zeros((~same).sum(), bool)
    for turn in 3e-5 * np.array([[1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1]]):
        beside = embree(origin[left], rays[left] + turn)
        found |= np.isclose(got[left], beside, rtol=5e-3, atol=1e-2) | (np.isinf(got[left]) & np.isinf(beside))
    assert found.all()


def test_a_solid_ellipsoid_is_hit_where_its_equation_says(firings: Firings) -> None:
    rng = np.random.default_rng(0)
    axes = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    center, radii = np.array([7.0, -2.0, -0.6]), np.array([1.4, 0.5, 0.8])
    ball = ellipsoids([center], [radii], np.array([[0.5, 0.0, 0.0]]), axes[None])
    hits = cast(bodies(ball), 0, None, firings, seed=1)
    met = np.isfinite(hits.rho_m)
    origin = np.stack([np.zeros_like(hits.rho_m)] * 2 + [np.broadcast_to(firings.origin_z_m[:, None], met.shape)], -1)
    rays = directions(firings)
    point = origin + rays * np.where(met, hits.rho_m, 0.0)[..., None]
    unit = (point - center) @ (axes / radii[:, None]).T
    assert met.sum() > 500
    np.testing.assert_allclose(np.linalg.norm(unit[met], axis=1), 1.0, atol=1e-9)
    # The rays that miss pass the ellipsoid: their nearest approach in its unit frame is beyond 1.
    p, q = (origin - center) @ (axes / radii[:, None]).T, rays @ (axes / radii[:, None]).T
    ahead = np.maximum(-(p * q).sum(-1) / (q * q).sum(-1), 0.0)
    nearest = np.linalg.norm(p + ahead[..., None] * q, axis=-1)
    assert (nearest[~met] > 1 - 1e-9).all()


def test_a_slope_around_the_sensor_is_not_hit_behind_it(firings: Firings) -> None:
    """A slanted triangle below and above the sensor spans every azimuth; a line meets its plane once, one way."""
    slope, height = 0.3, -1.5  # z = slope * x + height
    corners = np.array([(-80.0, -90.0), (90.0, 0.0), (-80.0, 90.0)])
    triangle = quads([[(x, y, slope * x + height) for x, y in (*corners, corners[0])]], Surface(0.5))
    rho = cast(bodies(triangle), 0, None, firings, seed=0).rho_m
    rays = directions(firings)
    with np.errstate(divide="ignore"):
        expected = (height - firings.origin_z_m[:, None]) / (rays[..., 2] - slope * rays[..., 0])
    ahead = (expected > 0) & (expected < 40)
    assert ahead.mean() > 0.2 and (expected < 0).mean() > 0.2
    np.testing.assert_allclose(rho[ahead], expected[ahead], rtol=1e-6)
    assert np.isinf(rho[expected < 0]).all()


def test_clouds_and_glass_let_their_shares_through(firings: Firings) -> None:
    """A slab of optical depth 1 (density 0.5 per metre, 2 m thick at its middle) stops 1 - 1/e of the rays."""
    cloud = ellipsoids([(10.0, 0.0, -1.0)], [(1.0, 40.0, 40.0)], np.array([[0.5, 0.0, 0.5]]))
    narrow = np.abs(np.arctan2(np.sin(firings.azimuth_rad), np.cos(firings.azimuth_rad))) < np.deg2rad(8)
    hits = [cast(bodies(cloud), 0, None, firings, seed).rho_m[10:40, narrow] for seed in range(6)]
    stopped = np.isfinite(np.stack(hits))
    assert stopped.mean() == pytest.approx(1 - np.exp(-1), abs=0.03)
    # Leaves grow in tufts: neighboring rays mostly share their fate, which chance alone would let agree at 53 %.
    assert 0.6 < (stopped[:, :, 1:] == stopped[:, :, :-1]).mean() < 0.9
    corners = [[(8, 6, -1), (8, -6, -1), (8, -6, 1), (8, 6, 1)], [(9, 20, -9), (9, -20, -9), (9, -20, 9), (9, 20, 9)]]
    surface = np.array([[0.1, 0.0, 0.75], [0.5, 0.0, 0.0]])
    rho = cast(bodies(quads(corners, surface)), 0, None, firings, seed=2).rho_m
    ahead = np.abs(np.arctan2(np.sin(firings.azimuth_rad), np.cos(firings.azimuth_rad))) < np.deg2rad(20)
    x = (rho * directions(firings)[..., 0])[:20, ahead]
    assert np.isclose(x, 8).mean() == pytest.approx(0.25, abs=0.02)
    assert (np.isclose(x, 8) | np.isclose(x, 9)).all()


def test_flat_ground_is_hit_at_its_height_with_the_right_incidence(firings: Firings) -> None:
    ground = Ground(make_street(half_width_m=200.0), np.zeros((49, 49)), np.full(5, 0.3), -1.73)
    hits = cast(bodies(Primitives.join([])), 0, ground, firings, seed=0)
    z = firings.origin_z_m[:, None] + hits.rho_m * firings.slope[:, None]
    met = hits.owner == GROUND
    np.testing.assert_allclose(z[met], -1.73, atol=0.002)
    reach = (-1.73 - firings.origin_z_m) / firings.slope
    sees = (firings.slope < 0) & (reach < 84)
    assert met[sees].all()
    assert (hits.owner[~sees] == NOTHING).all()
    steep = np.sin(np.arctan(-firings.slope))[:, None]
    np.testing.assert_allclose(hits.cosine[sees], np.broadcast_to(steep, hits.cosine.shape)[sees], atol=0.004)


def test_hilly_ground_is_hit_first_where_a_fine_march_hits_it(firings: Firings) -> None:
    relief = draw_relief(np.random.default_rng(4), (0.03, -0.02), 2.5)
    numbers = make_street(half_width_m=4.0, kerb_m=0.12, pavement_m=2.0, bank_left=0.15, bank_right=-0.1, yaw_rad=0.1)
    ground = Ground(numbers, relief, np.full(5, 0.3), -1.7)
    hits = cast(bodies(Primitives.join([])), 0, ground, firings, seed=0)
    rays = directions(firings)
    steps = np.arange(1.5, 84.0, 0.02)
    rng = np.random.default_rng(0)
    for ring, column in zip(rng.integers(0, 64, 300), rng.integers(0, 2150, 300), strict=True):
        gap = firings.origin_z_m[ring] + firings.slope[ring] * steps
        gap -= ground.heights(steps[:, None] * rays[ring, column, :2])
        below = np.flatnonzero(gap <= 0)
        expected = steps[below[0]] if len(below) else np.inf
        got = hits.rho_m[ring, column]
        # A ray that merely grazes a crest may be judged either way; elsewhere both meet the same slope.
        if np.isfinite(expected) and gap[: below[0]].min(initial=9.0) > -0.01:
            assert got == pytest.approx(expected, abs=0.05 + 0.02 * expected)


def test_hidden_and_lone_rays_are_counted_per_object(firings: Firings) -> None:
    """A wall hides the left half of a board: half of the rays that the board alone would stop still reach it."""
    board = quads([[(20, 2, -1), (20, -2, -1), (20, -2, 0.5), (20, 2, 0.5)]], Surface(0.5))
    wall = quads([[(10, 5, -3), (10, 0, -3), (10, 0, 3), (10, 5, 3)]], Surface(0.5))
    none = np.zeros(0, int)
    both = Bodies(Primitives.join([wall, board]), np.array([-1, -1, 0, 0]), np.arange(4), none, none)
    hits = cast(both, 1, None, firings, seed=0)
    assert hits.alone[0] > 300
    assert hits.visible[0] / hits.alone[0] == pytest.approx(0.5, abs=0.02)
    assert (hits.owner == 0).sum() == hits.visible[0]


def test_skipping_columns_leaves_the_others_as_they_are() -> None:
    every, ahead = (draw_firings(Lidar(), np.random.default_rng(1), camera_only=flag) for flag in (False, True))
    cloud = ellipsoids([(9, 1, 0)], [(2, 2, 2)], np.array([[0.3, 0, 0.4]]))
    street_ = bodies(Primitives.join([opaque_street(2), cloud]))
    whole, part = (cast(street_, 0, None, firings, seed=9) for firings in (every, ahead))
    np.testing.assert_array_equal(part.rho_m, whole.rho_m[:, ahead.number])
    np.testing.assert_array_equal(ahead.azimuth_rad, every.azimuth_rad[ahead.number])
    assert len(ahead.number) / every.columns_per_turn == pytest.approx(86 / 360, abs=0.01)


def test_ground_beyond_the_image_is_left_out_unless_it_hides_an_object_or_has_a_neighbor_in_the_image() -> None:
    firings = draw_firings(Lidar(), np.random.default_rng(1), camera_only=True)
    ground = Ground(make_street(half_width_m=200.0), np.zeros((49, 49)), np.full(8, 0.4), -1.73)
    outside = np.zeros(firings.hidden.shape, bool)
    outside[40:] = True
    # A board in the ground: the lower half of it is hidden.
    board = quads([[(6, 2, -3), (6, -2, -3), (6, -2, -0.5), (6, 2, -0.5)]], Surface(0.5))
    whole, part = (
        cast(bodies(board, owner=0), 1, ground, replace(firings, outside=mask), seed=0)
        for mask in (np.zeros_like(outside), outside)
    )
    np.testing.assert_array_equal(part.rho_m[:41], whole.rho_m[:41])
    assert 0 < part.visible[0] == whole.visible[0] < 0.9 * part.alone[0]
    assert np.isinf(part.rho_m[41:]).sum() > 0.5 * part.rho_m[41:].size and np.isfinite(whole.rho_m[41:]).all()
