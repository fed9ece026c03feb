"""People, sitting persons and riders, built of ellipsoids with jointed limbs; x ahead, feet on z = 0."""

import numpy as np
import numpy.typing as npt

from ..primitives import Primitives, Surface, ellipsoids, limbs, quads

Floats = npt.NDArray[np.float64]


def _cloth(rng: np.random.Generator, n: int) -> Floats:
    """(n,3) surfaces: skin and cloth are bright in the near infrared, whatever their colour; some cloth is black."""
    dark = rng.random(n) < 0.09
    value = np.where(dark, rng.uniform(0.003, 0.06, n), rng.uniform(0.18, 0.58, n))
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
    shoulder = np.clip(0.36 * width + 0.02, 0.14, 0.24)
    stride = np.clip(length / 2 - 0.12, 0.02, 0.5) * (1.0 if rng.random() < 0.85 else 0.2)
    phase = rng.choice([-1.0, 1.0])
    lean = rng.normal(0.02, 0.03) * h
    hip, chest, neck = 0.52 * h, 0.80 * h, 0.86 * h
    upper, lower, shoe = _cloth(rng, 3)
    skin = np.array([rng.uniform(0.3, 0.55), 0.2, 0.0])
    thick = rng.uniform(0.85, 1.2)
    rows: list[Limb] = [
        ((0, 0, hip), (lean, 0, chest), shoulder * 0.86, 0.115 * thick, upper),
        ((lean * 0.8, 0, 0.70 * h), (lean, 0, 0.84 * h), shoulder, 0.10 * thick, upper),
        ((0, 0, hip - 0.06 * h), (0, 0, hip + 0.04 * h), 0.16 * thick, 0.12 * thick, lower),
        ((lean, 0, 0.82 * h), (lean + 0.01, 0, neck), 0.055, 0.06, skin),
    ]
    for side in (1.0, -1.0):
        forward = stride * phase * side
        knee = (0.55 * forward + 0.06 * (forward > 0) + 0.02, side * 0.10, 0.28 * h + 0.02 * (forward > 0))
        foot = (forward, side * 0.09, 0.05)
        swing = -0.75 * forward + rng.normal(0.0, 0.04)
        bent = rng.uniform(0.0, 0.22) if rng.random() < 0.7 else rng.uniform(0.2, 0.35)
        top = (lean, side * (shoulder + 0.02), 0.81 * h)
        elbow = (lean + 0.45 * swing - 0.02, side * (shoulder + 0.05), 0.63 * h)
        inward = 0.4 * bent * (bent > 0.2)
        hand = (elbow[0] + 0.4 * swing + bent, side * (shoulder + 0.03 - inward), 0.50 * h + 0.5 * bent)
        rows += [
            ((0, side * 0.09, hip), knee, 0.075 * thick, 0.085 * thick, lower),
            (knee, foot, 0.055 * thick, 0.06 * thick, lower),
            ((forward - 0.07, side * 0.09, 0.04), (forward + 0.15, side * 0.10, 0.035), 0.045, 0.04, shoe),
            (top, elbow, 0.048 * thick, 0.05 * thick, upper),
            (elbow, hand, 0.036 * thick, 0.038 * thick, upper if rng.random() < 0.7 else skin),
        ]
    parts = [_jointed(rows)]
    parts.append(ellipsoids([(lean + 0.02, 0, 0.935 * h)], [(0.098, 0.078, 0.066 * h)], np.array([[*skin[:2], 0.0]])))
    if rng.random() < 0.3:  # a skirt or a coat
        parts.append(
            ellipsoids([(0, 0, 0.45 * h)], [(0.14 + 0.3 * stride, 0.19, rng.uniform(0.16, 0.26) * h)], lower[None])
        )
    burden = rng.random()
    if burden < 0.22:  # a rucksack
        parts.append(ellipsoids([(lean - 0.2, 0, 0.70 * h)], [(0.11, 0.15, 0.14 * h)], _cloth(rng, 1)))
    elif burden < 0.42:  # a bag in one hand
        side = rng.choice([-1.0, 1.0])
        parts.append(
            ellipsoids(
                [(rng.normal(0, 0.05), side * (shoulder + 0.06), 0.36 * h)], [(0.16, 0.07, 0.13)], _cloth(rng, 1)
            )
        )
    return Primitives.join(parts)


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
    rubber, spokes = Surface(0.06, 0.3), Surface(0.3, 0.3, 0.9)
    a, b, side = ring[:-1], ring[1:], np.array([0.0, 0.025, 0.0])
    faces = np.stack(
        [np.stack([a + side, b + side, b - side, a - side], 1), np.stack([a, b, 0.86 * b, 0.86 * a], 1),
         np.stack([0.86 * a, 0.86 * b, 0 * b, 0 * a], 1)]
    )  # fmt: skip
    hubs = np.array([[reach, 0.0, radius], [-reach, 0.0, radius]])
    corners = faces + hubs[:, None, None, None]
    table = np.stack([rubber.row, rubber.row, spokes.row])[None, :, None]
    frame = float(rng.uniform(0.08, 0.5))
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
    upper, lower = _cloth(rng, 2)
    skin = np.array([rng.uniform(0.3, 0.55), 0.2, 0.0])
    shoulder = float(np.clip(0.33 * width, 0.14, 0.22))
    bend = rng.uniform(0.05, 0.42)
    hips = np.array([-0.28, 0.0, 0.99])
    neck_z = height - 0.27
    neck = np.array([hips[0] + bend, 0.0, neck_z])
    reach = length / 2 - float(np.clip(0.19 * length, 0.26, 0.35)) - 0.28
    pedal = rng.uniform(0, 2 * np.pi)
    rows: list[Limb] = [
        (hips + np.array([0, 0, -0.05]), neck + np.array([0, 0, -0.04]), shoulder, 0.12, upper),
        (hips + np.array([-0.02, 0, -0.06]), hips + np.array([0.06, 0, 0.08]), 0.16, 0.13, lower),
    ]
    for side in (1.0, -1.0):
        turn = pedal + (np.pi if side > 0 else 0.0)
        foot = np.array([-0.08 + 0.17 * np.cos(turn), side * 0.11, 0.30 + 0.17 * np.sin(turn)])
        middle = 0.5 * (hips + foot)
        knee = np.array([middle[0] + 0.24, side * 0.12, middle[2] + 0.08])
        hand = np.array([reach, side * 0.27, 1.05])
        elbow = 0.5 * (neck + hand) + np.array([-0.04, side * 0.10, -0.06])
        rows += [
            (hips + np.array([0, side * 0.08, 0]), knee, 0.08, 0.085, lower),
            (knee, foot, 0.058, 0.06, lower),
            (foot + np.array([-0.08, 0, 0]), foot + np.array([0.14, 0, 0]), 0.045, 0.04, lower),
            (neck + np.array([0, side * shoulder, -0.05]), elbow, 0.05, 0.05, upper),
            (elbow, hand, 0.038, 0.038, upper),
        ]
    body = _jointed(rows)
    head = ellipsoids([(neck[0] + 0.05, 0, height - 0.13)], [(0.11, 0.085, 0.125)], skin[None])
    parts = [bike, body, head]
    if rng.random() < 0.25:
        parts.append(ellipsoids([(neck[0] - 0.24, 0, neck_z - 0.2)], [(0.12, 0.15, 0.2)], _cloth(rng, 1)))
    return Primitives.join(parts)
