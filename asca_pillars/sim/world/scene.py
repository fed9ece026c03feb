"""Random street: ground, objects, background and camera."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from asca_pillars.data.kitti import Calibration
from asca_pillars.sim.bodies import people, primitives, styles, vehicles
from asca_pillars.sim.bodies.primitives import BACKGROUND, Primitives
from asca_pillars.sim.casting.raycast import Bodies
from asca_pillars.sim.scene_config import SceneConfig
from asca_pillars.sim.world.builder import Builder
from asca_pillars.sim.world.clutter import fill_gaps, hide_partly, scatter
from asca_pillars.sim.world.ground import Ground
from asca_pillars.sim.world.placement import Occupied, Placer, Target
from asca_pillars.sim.world.roadside import line_streets
from asca_pillars.sim.world.streets import draw_ground, draw_kind, draws_of

# Kept free around the car: the sensor measures nothing within 2 m, and objects there would occlude the rest.
KEPT_CLEAR_M = 6.0, 4.0
BEAM_M_PER_M = 0.004  # width of a laser's beam per metre of distance
# Factors on the rates of cars, pedestrians and cyclists.
RATE_FACTORS = {
    "residential": (1.15, 0.75, 0.9),
    "urban": (1.0, 1.5, 1.2),
    "rural": (0.7, 0.25, 0.7),
    "campus": (0.8, 1.9, 1.4),
}
HABITS_OF = {"road": "rural", "alley": "residential"}  # kinds of street with the traffic of another kind


@dataclass(frozen=True)
class Scene:
    """Street before it is scanned. LiDAR frame, metres."""

    ground: Ground
    targets: tuple[Target, ...]
    background: Primitives
    calibration: Calibration


def draw_scene(config: SceneConfig, rng: np.random.Generator, arrange: Callable[[Placer], None] | None = None) -> Scene:
    """Draw a random street with everything on it.

    Args:
        config: bounds of the random quantities.
        rng: generator of the scene.
        arrange: changes the placed objects, before unlabelled ones are added.
    """
    kind = draw_kind(config, rng)
    habits = HABITS_OF.get(kind, kind)
    ground = draw_ground(config, rng, kind)
    occupied = Occupied()
    occupied.take(0.0, 0.0, *KEPT_CLEAR_M, 0.0)
    placer = Placer(rng, config, ground, occupied, habits)
    place_objects(placer)
    if arrange is not None:
        arrange(placer)
    builder = Builder(rng, config, ground, occupied, kind)
    hide_partly(builder, placer.half_hidden)
    fill_gaps(builder, placer.targets)
    line_streets(builder)
    scatter(builder)
    return Scene(ground, tuple(placer.targets), builder.primitives(), draw_calibration(rng))


def place_objects(placer: Placer) -> None:
    """Place as many objects of every class on a street as the configuration's rates suggest, or none at all."""
    rng, config = placer.rng, placer.config
    if rng.random() >= config.empty_share:
        for name, rate in _rates(config, placer.kind):
            crowds = name in ("Pedestrian", "Person_sitting")
            dispersion = config.people_dispersion if crowds else config.dispersion
            for ahead in (True, False):
                # A gamma-distributed rate makes the counts negative binomial.
                for _ in range(rng.poisson(rate * rng.gamma(dispersion) / dispersion)):
                    placer.place(name, ahead)
        for _ in range(rng.poisson(config.beyond)):
            placer.place_beyond()


def _rates(config: SceneConfig, kind: str) -> tuple[tuple[str, float], ...]:
    """Return mean numbers ahead for a kind of street; large objects come first, while there is room for them."""
    car, walkers, bike = RATE_FACTORS[kind]
    return (
        ("Tram", config.trams * (3.0 if kind == "urban" else 0.2)),
        ("Truck", config.trucks),
        ("Van", config.vans),
        ("Misc", config.misc),
        ("Car", config.cars * car),
        ("Cyclist", config.cyclists * bike),
        ("Pedestrian", config.pedestrians * walkers),
        ("Person_sitting", config.sitting * walkers),
    )


def draw_calibration(rng: np.random.Generator) -> Calibration:
    """Return a camera like one of KITTI's four recording days, slightly perturbed."""
    f, cx, cy, shift, pitch = (
        (707.05, 604.08, 180.51, (-0.025, -0.061, -0.332), -0.001),
        (721.54, 609.56, 172.85, (-0.004, -0.076, -0.272), 0.0148),
        (718.34, 600.39, 181.51, (-0.007, -0.063, -0.267), 0.008),
        (718.86, 607.19, 185.22, (-0.014, -0.055, -0.292), 0.008),
    )[int(rng.choice(4, p=(0.12, 0.76, 0.07, 0.05)))]
    p2 = np.array([[f, 0, cx, 44.9], [0, f, cy, 0.2], [0, 0, 1, 0.003]], float)
    axes = np.array([[0, -1, 0], [0, 0, -1], [1, 0, 0]], float)
    tilt = np.array([rng.normal(pitch, 0.002), rng.normal(0.0, 0.004), rng.normal(0.0, 0.003)])
    rotation = _rotation(tilt) @ axes
    r0_rect = _rotation(np.array([-0.0043, -0.0074, -0.0099]))
    return Calibration(p2, r0_rect, np.column_stack([rotation, shift]))


def _rotation(turns: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    """Return the rotation about the camera's x, y and z axes, in this order."""
    (cx, cy, cz), (sx, sy, sz) = np.cos(turns), np.sin(turns)
    about_x = np.array([[1, 0, 0], [0, cx, -sx], [0, sx, cx]])
    about_y = np.array([[cy, 0, sy], [0, 1, 0], [-sy, 0, cy]])
    about_z = np.array([[cz, -sz, 0], [sz, cz, 0], [0, 0, 1]])
    return np.asarray(about_z @ about_y @ about_x)


def body_of(target: Target, config: SceneConfig, rng: np.random.Generator) -> Primitives:
    """Return the placed body of an object: slightly smaller than its label box, as KITTI's labels are loose."""
    x, y, z, length, width, height, yaw = target.box
    name, footprint = target.type, BEAM_M_PER_M * float(np.hypot(x, y))
    if name in ("Car", "Van"):
        # Annotators fit boxes to many scans of a car: their faces are a few centimetres off the body, on either side.
        slack = rng.uniform((-0.08, -0.04, -0.05), (0.12, 0.10, 0.06))
        profile = styles.draw_style(rng, length, height, van=name == "Van")
        dark = config.dark_paint_share if name == "Car" else 0.1
        body = vehicles.car_body(rng, length - slack[0], width - slack[1], height - slack[2], profile, dark, footprint)
    elif name == "Truck":
        bus = rng.random() < 0.15
        body = (vehicles.bus_body if bus else vehicles.truck_body)(rng, length - 0.1, width - 0.08, height - 0.1)
    elif name == "Tram":
        body = vehicles.bus_body(rng, length - 0.1, width - 0.08, height - 0.1, rail=True)
    elif name == "Misc" and width < 1.0 and 1.4 < length < 2.5 and height > 1.35:
        body = people.motorcyclist_body(rng, height - 0.08, length - 0.06)
    elif name == "Misc":
        body = vehicles.trailer_body(rng, length - 0.08, width - 0.06, height - 0.08)
    elif name == "Pedestrian":
        body = people.pedestrian_body(rng, height - 0.05, width, length, target.walked_m)
    elif name == "Person_sitting":
        body = people.sitting_body(rng, height - 0.05)
    else:
        body = people.cyclist_body(rng, height - 0.08, width, length - 0.04, footprint)
    most = float(rng.uniform(*config.warp_m))
    if name in ("Pedestrian", "Person_sitting", "Cyclist"):
        body = primitives.scaled(body, rng.uniform((0.94, 0.94, 0.98), (1.06, 1.06, 1.02)))
        most *= 0.7  # for a person's size, waves as high as a car's would separate limbs
    body = primitives.warped(rng, body, most)
    if rng.random() < config.dark_patch_share:
        body = primitives.darkened(rng, body)
    dx, dy = rng.normal(0.0, config.box_offset_sigma_m, 2)
    if name in ("Pedestrian", "Person_sitting"):
        # Annotators center a person's box on the visible side, towards the sensor.
        behind = rng.normal(*config.person_behind_box_m) / max(float(np.hypot(x, y)), 1.0)
        dx, dy = dx + behind * x, dy + behind * y
    return body.placed(x + dx, y + dy, z - height / 2 - target.lift_m, yaw)


def build(
    scene: Scene,
    config: SceneConfig,
    seed: tuple[int, ...],
    within_rad: float,
    numbers: Sequence[int] | None = None,
) -> Bodies:
    """Return the primitives of a scene.

    Objects whose azimuth is beyond `within_rad` of straight ahead are left out; the random numbers of the others do not
    change by that. An object's body depends on `seed` and on its number; `numbers` are 0, 1, 2 ... if not given.
    """
    parts, owners, salts, blob_owners, blob_salts = [scene.background], [], [], [], []
    background = scene.background
    owners.append(np.full(len(background.triangles), BACKGROUND))
    salts.append(np.arange(len(background.triangles)))
    blob_owners.append(np.full(len(background.centers), BACKGROUND))
    blob_salts.append(len(background.triangles) + np.arange(len(background.centers)))
    for index, target in enumerate(scene.targets):
        distance = float(np.hypot(*target.box[:2]))
        reach = np.pi if distance < target.box[3] else np.arctan(0.6 * target.box[3] / distance)
        if abs(np.arctan2(target.box[1], target.box[0])) > within_rad + reach:
            continue
        number = index if numbers is None else numbers[index]
        body = body_of(target, config, draws_of(*seed, 1, number))
        first = 10_000_000 + number * 10_000
        parts.append(body)
        owners.append(np.full(len(body.triangles), index))
        salts.append(first + np.arange(len(body.triangles)))
        blob_owners.append(np.full(len(body.centers), index))
        blob_salts.append(first + 8000 + np.arange(len(body.centers)))
    return Bodies(
        Primitives.join(parts),
        np.concatenate(owners).astype(np.int64),
        np.concatenate(salts).astype(np.int64),
        np.concatenate(blob_owners).astype(np.int64),
        np.concatenate(blob_salts).astype(np.int64),
    )
