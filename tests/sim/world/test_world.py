"""The unlabelled world: bounds that hold over a handful of seeds, and what must never happen."""

import dataclasses

import numpy as np
import pytest

from asca_pillars.sim.bodies.primitives import BACKGROUND, Primitives
from asca_pillars.sim.casting.groundcast import BALLAST, GROUND, RAIL, ground_material
from asca_pillars.sim.casting.raycast import Bodies, Hits, cast
from asca_pillars.sim.lidar import Lidar, draw_firings
from asca_pillars.sim.scene_config import SceneConfig
from asca_pillars.sim.world import clutter
from asca_pillars.sim.world.builder import Builder, Stretch
from asca_pillars.sim.world.clutter import SHARES, scatter
from asca_pillars.sim.world.distractors import distractor
from asca_pillars.sim.world.ground import Ground, draw_relief, make_street
from asca_pillars.sim.world.placement import Occupied
from asca_pillars.sim.world.roadside import LININGS, building, close_view, line_streets
from asca_pillars.sim.world.scene import draw_scene
from asca_pillars.sim.world.streets import KINDS, draw_ground
from asca_pillars.sim.world.vegetation import shrub, wood

FLAT = np.zeros((49, 49))


def scenes(count: int, config: SceneConfig | None = None):  # type: ignore[no-untyped-def]
    return [draw_scene(config or SceneConfig(), np.random.default_rng([17, i])) for i in range(count)]


def builder_on(ground: Ground, kind: str = "residential", seed: int = 0) -> Builder:
    occupied = Occupied()
    occupied.take(0.0, 0.0, 6.0, 2.6, 0.0)
    return Builder(np.random.default_rng(seed), SceneConfig(), ground, occupied, kind)


def flat(**numbers: float) -> Ground:
    return Ground(make_street(**{"half_width_m": 3.0, "pavement_m": 1.0, **numbers}), FLAT, np.full(6, 0.3), -1.73)


def scan(primitives: Primitives, ground: Ground | None = None) -> tuple[Hits, np.ndarray]:
    """Hits of a whole revolution, and the points of all that was met (N,3)."""
    firings = draw_firings(Lidar(elevation_jitter_deg=0.0), np.random.default_rng(1), camera_only=False)
    triangles, ellipsoids = len(primitives.triangles), len(primitives.centers)
    owners = np.full(triangles, BACKGROUND), np.full(ellipsoids, BACKGROUND)
    bodies = Bodies(primitives, owners[0], np.arange(triangles), owners[1], triangles + np.arange(ellipsoids))
    hits = cast(bodies, 0, ground, firings, 5)
    ring, column = np.nonzero(hits.owner == BACKGROUND)
    rho, azimuth = hits.rho_m[ring, column], firings.azimuth_rad[column] + firings.phase_rad[ring]
    z = firings.origin_z_m[ring] + rho * firings.slope[ring]
    return hits, np.stack([rho * np.cos(azimuth), rho * np.sin(azimuth), z], axis=-1)


def test_nothing_of_the_background_stands_in_a_labelled_object() -> None:
    inside = seen = 0
    for scene in scenes(5):
        _, points = scan(scene.background)
        assert len(points) > 20_000
        for target in scene.targets:
            x, y, z, length, width, height, yaw = target.box
            cos, sin = np.cos(yaw), np.sin(yaw)
            dx, dy, dz = points[:, 0] - x, points[:, 1] - y, points[:, 2] - z
            # Leaves may hang over a roof; what stands may not reach in.
            within = (np.abs(dx * cos + dy * sin) < length / 2 - 0.15) & (
                np.abs(dy * cos - dx * sin) < width / 2 - 0.15
            )
            inside += int((within & (np.abs(dz) < height / 2 - 0.1)).sum())
            seen += 1
    assert seen > 50
    assert inside < 0.5 * seen


@pytest.mark.parametrize("kind", KINDS)
def test_every_kind_of_street_is_lined_and_cluttered(kind: str) -> None:
    rng = np.random.default_rng([3, len(kind)])
    ground = draw_ground(SceneConfig(), rng, kind)
    builder = builder_on(ground, kind)
    line_streets(builder)
    lined = builder.occupied.count
    scatter(builder)
    primitives = builder.primitives()
    assert lined > 20
    assert builder.occupied.count > lined
    assert np.isfinite(primitives.triangles).all()
    assert np.isfinite(primitives.unit_from_world).all()
    reflectance = primitives.triangle_surface[:, 0]
    assert (reflectance > 0).all() and (reflectance <= 5).all()  # foil sends light back to where it came from
    assert set(LININGS) == set(KINDS)


@pytest.mark.parametrize("thing", [*SHARES, distractor], ids=lambda thing: thing.__name__)
def test_every_thing_keeps_out_of_what_is_taken(thing) -> None:  # type: ignore[no-untyped-def]
    builder = builder_on(flat())
    builder.occupied = Occupied()
    assert builder.occupied.take(0.0, 0.0, 200.0, 200.0, 0.0)
    for _ in range(3):
        thing(builder, 5.0, 6.0)
    assert len(builder.primitives().triangles) == 0
    assert len(builder.primitives().centers) == 0
    free = builder_on(flat(), seed=3)
    thing(free, 8.0, 6.0)
    body = free.primitives()
    low = [part.min() for part in (body.triangles[..., 2].ravel(), body.centers[:, 2]) if part.size]
    assert low and -2.4 < min(low) < 0.5


def test_as_many_things_are_distractors_as_asked_for(monkeypatch: pytest.MonkeyPatch) -> None:
    distractors: list[float] = []
    monkeypatch.setattr(clutter, "distractor", lambda builder, along, across: distractors.append(along))
    things = dict.fromkeys(SHARES, 0)

    def counted(thing):  # type: ignore[no-untyped-def]
        def count(builder: Builder, along: float, across: float) -> None:
            things[thing] += 1

        return count

    monkeypatch.setattr(clutter, "SHARES", {counted(thing): share for thing, share in SHARES.items()})
    monkeypatch.setattr(clutter, "FAR", tuple(map(counted, clutter.FAR)))
    for share in (0.0, 0.35, 1.0):
        distractors.clear()
        things = dict.fromkeys(SHARES, 0)
        for seed in range(5):
            builder = builder_on(flat(), seed=seed)
            scatter(dataclasses.replace(builder, config=SceneConfig(distractor_share=share)))
        count = sum(things.values()) + len(distractors)
        assert count > 300
        assert len(distractors) == pytest.approx(share * count, abs=0 if share in (0, 1) else 0.06 * count)


def test_distractors_are_as_large_as_a_person_and_differ() -> None:
    tall = []
    for seed in range(40):
        builder = builder_on(flat(), seed=seed)
        distractor(builder, 9.0, 6.0)
        _, points = scan(builder.primitives())
        near = np.hypot(points[:, 0] - 9.0, points[:, 1] - 6.0) < 0.65
        heights = points[near, 2] + 1.73
        if len(heights) > 20:
            tall.append(np.percentile(heights, 90))
    assert len(tall) > 30
    assert np.percentile(tall, 5) > 0.6 and np.percentile(tall, 80) < 2.4
    assert np.std(tall) > 0.3


def test_rays_go_into_woods_and_through_shrubs() -> None:
    ground = flat()
    builder = builder_on(ground, seed=2)
    wood(builder, Stretch(-15.0, 30.0, 1.0, 8.0))
    _, points = scan(builder.primitives())
    before = points[(np.abs(points[:, 0]) < 8) & (points[:, 2] > -1.2) & (points[:, 2] < 0.0)]
    depth = before[:, 1]
    assert 0.25 < depth.std() < 2.0
    assert np.percentile(depth, 95) - np.percentile(depth, 5) > 1.0
    # Neighboring firings meet the same cluster more often than not: leaves are no noise.
    assert np.median(np.abs(np.diff(depth))) < 0.25
    through = met = 0
    for seed in range(12):
        ground = flat()
        builder = builder_on(ground, seed=seed)
        shrub(builder, 0.0, 8.0, tall=True)
        hits, points = scan(builder.primitives(), ground)
        around = (np.abs(points[:, 0]) < 0.4) & (np.abs(points[:, 1] - 8.0) < 1.5)
        met += int(around.sum())
        # Rays toward the shrub's middle that meet the ground behind it.
        firings = draw_firings(Lidar(elevation_jitter_deg=0.0), np.random.default_rng(1), camera_only=False)
        toward = np.abs(firings.azimuth_rad - np.pi / 2) < 0.03
        rings = (firings.slope * 8.0 > -1.5) & (firings.slope * 8.0 < -0.6)
        rho = hits.rho_m[rings][:, toward]
        through += int(((rho > 9.5) & np.isfinite(rho)).sum())
    assert met > 500
    assert through > 50


def test_grounds_have_the_statistics_of_real_streets_and_hills_leave_the_road_level() -> None:
    """KITTI: slope ahead 0.011 +- 0.004, to the left -0.009 +- 0.018, ground 1.73 +- 0.04 m below the sensor."""
    offsets = np.array([(0.0, 0.0), (8.0, 0.0), (-8.0, 0.0)])
    rng = np.random.default_rng(8)
    heights = np.array([draw_ground(SceneConfig(), rng, KINDS[i % len(KINDS)]).heights(offsets) for i in range(60)])
    slope_x = (heights[:, 1] - heights[:, 2]) / 16.0
    assert abs(slope_x.mean() - 0.011) < 0.003
    assert slope_x.std() < 0.009
    assert abs(heights[:, 0].mean() + 1.75) < 0.03
    assert np.abs(heights[:, 1:] - heights[:, :1]).max() < 0.6
    relief = draw_relief(np.random.default_rng(5), (0.0, 0.0), 3.0)
    middle = len(relief) // 2
    near = relief[middle - 2 : middle + 3, middle - 2 : middle + 3]
    assert np.abs(near).max() < 0.25 * max(np.abs(relief).max(), 0.1)


def test_grounds_roads_and_their_coordinates() -> None:
    ground = flat(rails_v_m=8.0, tracks=2.0, bed_m=0.2, bed_half_m=3.2, rail_m=0.15)
    rails = np.array([8.0 + track + rail for track in (-1.7, 1.7) for rail in (-0.75, 0.75)])
    points = np.stack([np.full(4, 12.0), rails], axis=-1)
    np.testing.assert_allclose(ground.heights(points), -1.73 + 0.35)
    assert ground.heights((12.0, 8.0))[0] == pytest.approx(-1.73 + 0.2)
    assert ground_material(12.0, rails[0], ground.street) == RAIL
    assert ground_material(12.0, 8.0, ground.street) == BALLAST
    assert ground.left_edge_m == pytest.approx(11.2)
    ground = flat(second_v_m=9.0, second_half_m=3.0, bank_left=0.3, kerb_m=0.1)
    assert ground.heights((0.0, 9.0))[0] == pytest.approx(-1.73)
    assert ground.heights((0.0, 16.0))[0] == pytest.approx(-1.73 + 0.1 + 0.3 * 3.0)
    numbers = {"ditch_m": 0.4, "cross_u_m": 40.0, "cross_half_m": 3.0}
    assert flat(**numbers).heights((0.0, 5.0))[0] == pytest.approx(-1.73 - 0.4)
    assert flat(**numbers).heights((35.5, 5.0))[0] == pytest.approx(-1.73)
    with pytest.raises(TypeError, match="curb_m"):
        make_street(curb_m=0.1)
    ground = flat(yaw_rad=0.3, bend_per_m=0.004, offset_m=1.4)
    rng = np.random.default_rng(0)
    for u, v in rng.uniform(-60.0, 60.0, (20, 2)):
        x, y, _ = ground.to_lidar(float(u), float(v))
        np.testing.assert_allclose(ground.to_road(x, y), (u, v), atol=1e-9)
    ground = flat(yaw_rad=0.3, bend_per_m=0.004, offset_m=1.4, cross_u_m=12.0, cross_half_m=3.0, cross_tilt_rad=-0.2)
    rng = np.random.default_rng(1)
    (along, across), cross = rng.uniform(-60.0, 60.0, (2, 40)), rng.random(40) < 0.5
    one_by_one = [
        (ground.cross_to_lidar if beside else ground.to_lidar)(float(u), float(v))
        for u, v, beside in zip(along, across, cross, strict=True)
    ]
    at_once = np.column_stack([ground.places(along, across, cross), ground.headings(along, cross)])
    np.testing.assert_array_equal(at_once, one_by_one)


def test_closed_ends_and_houses_stand_where_they_are_asked_for() -> None:
    builder = builder_on(flat(), seed=1)
    building(builder, Stretch(10.0, 16.0, 1.0, 5.0))
    front = builder.primitives().triangles[..., :2].reshape(-1, 2)
    assert front[:, 1].min() > 3.0
    for seed in range(4):
        builder = builder_on(flat(), seed=seed)
        close_view(builder, 40.0, 12.0)
        _, points = scan(builder.primitives())
        assert len(points) > 300
        assert points[:, 0].min() > 33.0


def test_scans_of_the_world_have_the_shape_of_real_ones() -> None:
    """KITTI: 55 +- 11 % of the points on the ground, 84 % of the firings of the top rings return."""
    on_ground, high = [], []
    for scene in scenes(12):
        hits, _ = scan(scene.background, scene.ground)
        met = hits.rho_m < 79.0
        on_ground.append((hits.owner[met] == GROUND).mean())
        high.append(met[:8].mean())
    assert 0.47 < np.mean(on_ground) < 0.67  # a little more than in scans, where weak returns are lost
    assert 0.74 < np.mean(high) < 0.95
    assert np.std(on_ground) > 0.05
