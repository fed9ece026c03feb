"""People, sitting persons and riders, built of ellipsoids with jointed limbs; x ahead, feet on z = 0."""

import numpy as np
import numpy.typing as npt

from asca_pillars.sim.bodies.primitives import Primitives, Surface, cuboids, ellipsoids, limbs, quads

Floats = npt.NDArray[np.float64]


def _cloth(rng: np.random.Generator, n: int, dark_share: float = 0.1) -> Floats:
    """(n,3) surfaces: skin and cloth are bright in the near infrared, whatever their colour; some cloth is black."""
    dark = rng.random(n) < dark_share
    value = np.where(dark, rng.uniform(0.003, 0.06, n), rng.uniform(0.12, 0.8, n))
    return np.column_stack([value, rng.uniform(0.05, 0.4, n), np.zeros(n)])


# From, to, radius sideways, radius across, surface.
Limb = tuple[npt.ArrayLike, npt.ArrayLike, float, float, Floats]


def _jointed(rows: list[Limb]) -> Primitives:
    starts, ends, sideways, across, surfaces = zip(*rows, strict=True)
    radii = np.column_stack([sideways, across])
    return limbs(np.array(starts), np.array(ends), radii, np.array(surfaces), (0.0, 1.0, 0.0))


def pedestrian_body(rng: np.random.Generator, height: float, width: float, length: float) -> Primitives:
    """A standing or walking person. `width` bounds the shoulders and arms, `length` the step and the swing."""
    h = height
    shoulder = float(np.clip(0.36 * width + 0.02, 0.14, 0.24)) * min(h / 1.6, 1.0)
    lean = float(rng.normal(0.02, 0.03)) * h
    upper, lower, shoe = _cloth(rng, 3)
    skin = np.array([rng.uniform(0.3, 0.55), 0.2, 0.0])
    thick = float(rng.uniform(0.9, 1.3))
    # A box covers all the poses of a walk: in a single scan the feet are somewhere between together and far apart.
    stride = float(np.clip(length / 2 - 0.12, 0.02, 0.5)) * (1.0 if rng.random() < 0.88 else 0.2)
    phase = float(rng.uniform(0.0, 2 * np.pi))
    rows: list[Limb] = [
        ((0, 0, 0.52 * h), (lean, 0, 0.80 * h), shoulder * 0.88, 0.118 * thick, upper),
        ((lean * 0.8, 0, 0.70 * h), (lean, 0, 0.84 * h), shoulder, 0.105 * thick, upper),
        ((0, 0, 0.46 * h), (0, 0, 0.56 * h), 0.16 * thick, 0.125 * thick, lower),
        ((lean, 0, 0.82 * h), (lean + 0.01, 0, 0.86 * h), 0.055, 0.06, skin),
    ]
    for side in (1.0, -1.0):
        rows += _leg(h, side, stride, phase, thick, (lower, shoe))
        rows += _arm(rng, h, side, -0.75 * stride * np.sin(phase) * side, (lean, shoulder), (upper, skin))
    size = 0.066 if h > 1.4 else 0.076  # children have larger heads
    head = [(lean + 0.02, 0, (1.0 - size) * h), (lean - 0.005, 0, (1.0 - 0.92 * size) * h)]
    hair = _cloth(rng, 1)[0] * (0.6, 1.0, 1.0)
    parts = [
        _jointed(rows),
        ellipsoids(head, [(0.098, 0.078, size * h), (0.10, 0.085, 0.88 * size * h)], np.stack([skin, hair])),
    ]
    dress = rng.random()
    if dress < 0.2:  # a skirt
        skirt = (0.14 + 0.3 * stride, 0.19, rng.uniform(0.16, 0.26) * h)
        parts.append(ellipsoids([(0, 0, 0.45 * h)], [skirt], lower[None]))
    elif dress < 0.45:  # a coat
        coat = (0.15 * thick + 0.1 * stride, 0.95 * shoulder + 0.03, rng.uniform(0.24, 0.32) * h)
        parts.append(ellipsoids([(0.3 * lean, 0, 0.58 * h)], [coat], upper[None]))
    parts.append(_burden(rng, h, lean, shoulder))
    return Primitives.join(parts)


def _leg(h: float, side: float, stride: float, phase: float, thick: float, cloth: tuple[Floats, Floats]) -> list[Limb]:
    """Thigh, shin and shoe of a walker; the leg that swings forward is bent and off the ground."""
    lower, shoe = cloth
    forward = stride * np.sin(phase) * side
    lift = 0.5 * min(stride, 0.3) * max(np.cos(phase) * side, 0.0)
    foot = (forward - 0.3 * lift, side * 0.09, 0.05 + lift)
    knee = (0.52 * forward + 0.03 + 0.06 * (forward > 0) + 0.6 * lift, side * 0.10, 0.28 * h + 0.35 * lift)
    heel = 0.10 * max(-forward - 0.1, 0.0)
    return [
        ((0, side * 0.09, 0.52 * h), knee, 0.078 * thick, 0.088 * thick, lower),
        (knee, foot, 0.056 * thick, 0.062 * thick, lower),
        ((foot[0] - 0.07, foot[1], foot[2] - 0.01 + heel), (foot[0] + 0.15, side * 0.10, foot[2] - 0.015),
         0.045, 0.04, shoe),
    ]  # fmt: skip


def _arm(
    rng: np.random.Generator,
    h: float,
    side: float,
    swing: float,
    trunk: tuple[float, float],
    cloth: tuple[Floats, Floats],
) -> list[Limb]:
    """Upper arm and forearm: hanging and swinging, or bent to hold, point or telephone. `trunk`: lean, shoulder."""
    lean, shoulder = trunk
    upper, skin = cloth
    swing += float(rng.normal(0.0, 0.04))
    habit = rng.random()
    bent = rng.uniform(0.0, 0.22) if habit < 0.7 else rng.uniform(0.2, 0.35)
    elbow = (lean + 0.45 * swing - 0.02, side * (shoulder + 0.05), 0.63 * h)
    inward = 0.4 * bent * (bent > 0.2)
    hand = (elbow[0] + 0.4 * swing + bent, side * (shoulder + 0.03 - inward), 0.50 * h + 0.5 * bent)
    if habit > 0.95:  # at the ear
        hand = (lean + 0.08, side * 0.12, 0.88 * h)
    return [
        ((lean, side * (shoulder + 0.02), 0.81 * h), elbow, 0.05, 0.053, upper),
        (elbow, hand, 0.038, 0.04, upper if rng.random() < 0.7 else skin),
    ]


def _burden(rng: np.random.Generator, h: float, lean: float, shoulder: float) -> Primitives:
    """What a person carries, pulls or pushes; often nothing."""
    what = rng.random()
    side = float(rng.choice([-1.0, 1.0]))
    cloth = _cloth(rng, 1)
    if what < 0.20:  # a rucksack
        return ellipsoids([(lean - 0.2, 0, 0.70 * h)], [(0.11, 0.15, 0.14 * h)], cloth)
    if what < 0.36:  # a bag in one hand
        place = (rng.normal(0, 0.05), side * (shoulder + 0.06), 0.36 * h)
        return ellipsoids([place], [(0.16, 0.07, 0.13)], cloth)
    if what < 0.46:  # a bag at the hip
        return ellipsoids([(-0.02, side * 0.2, 0.53 * h)], [(0.15, 0.07, 0.11)], cloth)
    if what < 0.485:  # a suitcase on wheels
        return cuboids([(-0.5, side * 0.2, 0.05, 0.25, 0.4, 0.6, 0.0, *cloth[0, :2], 0.0)])
    if what < 0.515 and h > 1.5:  # a pram: its tub, its hood and its wheels
        return Primitives.join([
            ellipsoids([(0.75, 0, 0.72), (0.58, 0, 0.88)], [(0.38, 0.22, 0.17), (0.16, 0.22, 0.17)],
                       np.repeat(cloth, 2, axis=0)),
            cuboids([(x, y, 0.0, 0.2, 0.04, 0.22, 0.0, 0.1, 0.3, 0.4) for x in (0.5, 1.0) for y in (0.24, -0.24)]),
        ])  # fmt: skip
    return Primitives.join([])


def sitting_body(rng: np.random.Generator, height: float) -> Primitives:
    """A person on a chair or a bench; `height` is that of the head above the ground."""
    h = height
    upper, lower = _cloth(rng, 2)
    seat = 0.36 * h
    rows: list[Limb] = [((-0.1, 0, seat), (-0.14, 0, 0.78 * h), 0.19, 0.12, upper)]
    for side in (0.11, -0.11):
        rows += [
            ((-0.1, side, seat + 0.03), (0.32, side * 1.3, seat + 0.05), 0.08, 0.08, lower),
            ((0.32, side * 1.3, seat + 0.04), (0.34, side * 1.2, 0.06), 0.06, 0.06, lower),
            ((0.28, side * 1.2, 0.05), (0.48, side * 1.3, 0.04), 0.045, 0.04, lower),
            ((-0.12, side * 1.9, 0.76 * h), (0.02, side * 2.1, 0.55 * h), 0.05, 0.05, upper),
            ((0.02, side * 2.1, 0.55 * h), (0.25, side * 1.2, 0.52 * h), 0.04, 0.04, upper),
        ]
    head = ellipsoids([(-0.1, 0, 0.91 * h)], [(0.10, 0.08, 0.09 * h)], np.array([[0.4, 0.2, 0.0]]))
    chair = Surface(0.2, 0.3)
    boards = quads(
        [
            [
                (-0.3, 0.24, seat - 0.05),
                (0.2, 0.24, seat - 0.05),
                (0.2, -0.24, seat - 0.05),
                (-0.3, -0.24, seat - 0.05),
            ],
            [(-0.3, 0.24, seat), (-0.34, 0.24, 0.65 * h), (-0.34, -0.24, 0.65 * h), (-0.3, -0.24, seat)],
        ],
        chair,
    )
    return Primitives.join([_jointed(rows), head, boards])


def bicycle(rng: np.random.Generator, length: float) -> Primitives:
    """A bicycle: tyres, spokes that let most rays through, frame tubes, handlebar, saddle."""
    radius = float(np.clip(0.19 * length, 0.26, 0.35))
    reach = length / 2 - radius
    angle = np.linspace(0, 2 * np.pi, 17)
    ring = radius * np.stack([np.cos(angle), np.zeros(17), np.sin(angle)], axis=1)
    rubber, spokes = Surface(0.07, 0.3), Surface(0.08, 0.3, 0.9)
    a, b, side = ring[:-1], ring[1:], np.array([0.0, 0.025, 0.0])
    faces = np.stack(
        [np.stack([a + side, b + side, b - side, a - side], 1), np.stack([a, b, 0.86 * b, 0.86 * a], 1),
         np.stack([0.86 * a, 0.86 * b, 0 * b, 0 * a], 1)]
    )  # fmt: skip
    hubs = np.array([[reach, 0.0, radius], [-reach, 0.0, radius]])
    corners = faces + hubs[:, None, None, None]
    table = np.stack([rubber.row, rubber.row, spokes.row])[None, :, None]
    frame = float(np.exp(rng.uniform(np.log(0.03), np.log(0.2))))
    head, crank, post = (reach - 0.22, 0.0, 0.80), (-0.08, 0.0, 0.30), (-0.26, 0.0, 0.80)
    tubes = [(head, crank), (post, crank), (head, post), (post, (-reach, 0, radius)), (crank, (-reach, 0, radius)),
             (head, (reach, 0, radius)), (head, (head[0] - 0.06, 0, 1.02)), (post, (post[0] - 0.04, 0, 0.95)),
             ((head[0] - 0.06, 0.29, 1.03), (head[0] - 0.06, -0.29, 1.03))]  # fmt: skip
    radii = np.full((len(tubes), 2), 0.019)
    surface = np.tile([frame, 0.4, 0.0], (len(tubes), 1))
    tube = limbs([t[0] for t in tubes], [t[1] for t in tubes], radii, surface, (0.0, 1.0, 0.0))
    saddle = ellipsoids([(post[0] - 0.05, 0, 0.96)], [(0.14, 0.08, 0.05)], np.array([[0.05, 0.3, 0.0]]))
    return Primitives.join([quads(corners, np.broadcast_to(table, (*corners.shape[:3], 3))), tube, saddle])


def cyclist_body(rng: np.random.Generator, height: float, width: float, length: float) -> Primitives:
    """A bicycle and its rider, upright to bent over; `height` is that of the head above the ground."""
    bike = bicycle(rng, length)
    upper, lower = _cloth(rng, 2, dark_share=0.22)
    skin = np.array([rng.uniform(0.3, 0.55), 0.2, 0.0])
    shoulder = float(np.clip(0.33 * width, 0.14, 0.22))
    bend = rng.uniform(0.05, 0.42)
    hips = np.array([-0.28, 0.0, 0.99])
    neck_z = height - 0.27
    neck = np.array([hips[0] + bend, 0.0, neck_z])
    reach = length / 2 - float(np.clip(0.19 * length, 0.26, 0.35)) - 0.28
    pedal = rng.uniform(0, 2 * np.pi)
    grip = float(np.clip(0.45 * width, 0.2, 0.29))
    rows: list[Limb] = [
        (hips + np.array([0, 0, -0.05]), neck + np.array([0, 0, -0.04]), shoulder, 0.12, upper),
        (hips + np.array([-0.02, 0, -0.06]), hips + np.array([0.06, 0, 0.08]), 0.16, 0.13, lower),
    ]
    for side in (1.0, -1.0):
        turn = pedal + (np.pi if side > 0 else 0.0)
        foot = np.array([-0.08 + 0.17 * np.cos(turn), side * 0.11, 0.30 + 0.17 * np.sin(turn)])
        middle = 0.5 * (hips + foot)
        knee = np.array([middle[0] + 0.24, side * 0.12, middle[2] + 0.08])
        hand = np.array([reach, side * grip, 1.05])
        elbow = 0.5 * (neck + hand) + np.array([-0.04, side * 0.10, -0.06])
        rows += [
            (hips + np.array([0, side * 0.08, 0]), knee, 0.08, 0.085, lower),
            (knee, foot, 0.058, 0.06, lower),
            (foot + np.array([-0.08, 0, 0]), foot + np.array([0.14, 0, 0]), 0.045, 0.04, lower),
            (neck + np.array([0, side * shoulder, -0.05]), elbow, 0.05, 0.05, upper),
            (elbow, hand, 0.038, 0.038, upper),
        ]
    body = _jointed(rows)
    crown = _cloth(rng, 1)[0]  # hair or a helmet
    head = [(neck[0] + 0.06, 0, height - 0.13), (neck[0] + 0.03, 0, height - 0.115)]
    parts = [bike, body, ellipsoids(head, [(0.11, 0.082, 0.125), (0.12, 0.09, 0.11)], np.stack([skin, crown]))]
    luggage = rng.random()
    if luggage < 0.22:  # a rucksack
        parts.append(ellipsoids([(neck[0] - 0.24, 0, neck_z - 0.2)], [(0.12, 0.15, 0.2)], _cloth(rng, 1)))
    elif luggage < 0.36:  # panniers
        bag = np.repeat(_cloth(rng, 1), 2, axis=0)
        parts.append(ellipsoids([(-0.55, y, 0.6) for y in (0.17, -0.17)], [(0.19, 0.09, 0.19)] * 2, bag))
    elif luggage < 0.46:  # a basket over the front wheel
        parts.append(cuboids([(reach + 0.2, 0, 0.8, 0.26, 0.34, 0.24, 0, 0.3, 0.3, 0.5)]))
    elif luggage < 0.51:  # a child behind the saddle
        seat = [(-0.56, 0, 0.92), (-0.58, 0, 1.26)]
        parts.append(ellipsoids(seat, [(0.14, 0.15, 0.26), (0.095, 0.08, 0.11)], _cloth(rng, 2)))
    return Primitives.join(parts)
