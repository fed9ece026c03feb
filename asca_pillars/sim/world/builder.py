"""Collection of the unlabelled bodies of a street as rows of primitives, placed on the ground at once."""

from dataclasses import dataclass, field

import numpy as np

from asca_pillars.base.compiling import cached
from asca_pillars.geometry.boxes import Floats, Mask
from asca_pillars.sim.bodies.primitives import Primitives, cuboids, ellipsoids, prisms
from asca_pillars.sim.scene_config import SceneConfig
from asca_pillars.sim.world.ground import Ground
from asca_pillars.sim.world.placement import Occupied

Material = tuple[float, float, float]  # reflectance, gloss, transparency
HEAD_ROOM_M = 2.2  # leaves above this height may be over objects


@dataclass(frozen=True)
class Stretch:
    """Section of one side of a road: from `start_m` on for `length_m` along it, `away_m` from its middle.

    `side` is 1 left of the road and -1 right of it; `cross` means the crossing road.
    """

    start_m: float
    length_m: float
    side: float
    away_m: float
    cross: bool = False

    @property
    def middle_m(self) -> float:
        """Position of its middle along the road."""
        return self.start_m + self.length_m / 2

    def along(self, step_m: float) -> Floats:
        """Return the middles (N,) of as many pieces of `step_m` as fit, metres."""
        return np.asarray(np.arange(self.start_m + step_m / 2, self.start_m + self.length_m - 0.45 * step_m, step_m))


@dataclass
class Builder:
    """Bodies collected so far.

    Until `primitives` places them on the ground all at once, rows are in road coordinates, with heights above the local
    ground, and end with 1 beside the crossing road, 0 beside the main one.
    """

    rng: np.random.Generator
    config: SceneConfig
    ground: Ground
    occupied: Occupied
    kind: str
    _kept_clear: Floats = field(init=False)  # footprints of the car and of the objects
    _bodies: list[Primitives] = field(default_factory=list)
    _boxes: list[tuple[float, ...]] = field(default_factory=list)  # as for `cuboids`, yaw against the road
    _posts: list[tuple[float, ...]] = field(default_factory=list)  # as for `prisms`
    _blobs: list[Floats] = field(default_factory=list)  # rows of x y z, radii, yaw, reflectance, density

    def __post_init__(self) -> None:
        self._kept_clear = self.occupied.rows[: self.occupied.count].copy()

    def to_lidar(self, along: float, across: float, cross: bool = False) -> tuple[float, float, float]:
        """Return a position beside the main or the crossing road as x, y and the road's heading."""
        return (self.ground.cross_to_lidar if cross else self.ground.to_lidar)(along, across)

    def near_junction(self, start_m: float, end_m: float) -> bool:
        """Return whether a section of the main road's side would be on the crossing road."""
        reach = self.ground.cross_half_m + self.ground.pavement_m + 1.0
        middle = self.ground.cross_u_m
        return self.ground.cross_half_m > 0 and start_m < middle + reach and end_m > middle - reach

    def until_junction(self, start_m: float, length_m: float) -> float:
        """Return the length of the part of a section of the main road's side before the crossing road."""
        first = self.ground.cross_u_m - self.ground.cross_half_m - self.ground.pavement_m - 1.0
        return first - start_m if self.ground.cross_half_m > 0 and start_m < first < start_m + length_m else length_m

    def reserve(self, along: float, across: float, length: float, width: float, cross: bool = False) -> bool:
        """Reserve a rectangle aligned with the road; False if it was occupied."""
        x, y, yaw = self.to_lidar(along, across, cross)
        return self.occupied.take(x, y, length, width, yaw)

    def body(self, body: Primitives, along: float, across: float, yaw: float) -> None:
        """Add any body, at a position beside the main road and rotated relative to it."""
        x, y, heading = self.to_lidar(along, across)
        z = float(self.ground.heights((x, y))[0])
        self._bodies.append(body.placed(x, y, z, heading + yaw))

    def box(
        self,
        along: float,
        across: float,
        z: float,
        size: tuple[float, float, float],
        material: Material,
        cross: bool = False,
        yaw: float = 0.0,
    ) -> None:
        """Add a box of `size` (along, across, up) whose bottom is z above the ground."""
        self._boxes.append((along, across, z, *size, yaw, *material, cross))

    def post(
        self,
        along: float,
        across: float,
        z: float,
        height: float,
        radius: float,
        reflectance: float,
        cross: bool = False,
        *,
        taper: float = 1.0,
        lean: tuple[float, float] = (0.0, 0.0),
    ) -> None:
        """Add a round post whose radius at the top is `taper` times that at the foot.

        It leans by `lean` metres per metre of height along x and y.
        """
        self._posts.append((along, across, z, height, radius, taper * radius, reflectance, *lean, cross))

    def ball(
        self, along: float, across: float, z: float, radii: tuple[float, float, float], reflectance: float
    ) -> None:
        """Add a solid ellipsoid around z above the ground."""
        _, _, yaw = self.to_lidar(along, across)
        self._blobs.append(np.array([[along, across, z, *radii, yaw, reflectance, 0.0, 0.0]]))

    def clouds(
        self,
        along: Floats,
        across: Floats,
        z: Floats,
        radii: Floats,
        reflectance: float,
        density_per_m: Floats,
        cross: bool = False,
        *,
        turned: bool = True,
    ) -> None:
        """Add n clouds of leaves: ellipsoids of radii (N, 3), metres, around z (N,) above the ground.

        Each is rotated at random or, for hedges, along the road.
        """
        rows = np.empty((len(along), 10))
        rows[:, 0], rows[:, 1], rows[:, 2], rows[:, 3:6] = along, across, z, radii
        if turned:
            rows[:, 6] = self.rng.uniform(0.0, np.pi, len(along))
        else:
            rows[:, 6] = self.to_lidar(float(along[0]), float(across[0]), cross)[2]
        rows[:, 7], rows[:, 8], rows[:, 9] = reflectance, density_per_m, cross
        self._blobs.append(rows)

    def primitives(self) -> Primitives:
        """Return all bodies, placed on the ground."""
        parts = list(self._bodies)
        if self._boxes:
            rows = np.array(self._boxes)
            rows[:, 6] += self.ground.headings(rows[:, 0], rows[:, -1] > 0)
            parts.append(cuboids(self._grounded(self._placed(rows))))
        if self._posts:
            parts.append(prisms(self._grounded(self._placed(np.array(self._posts))), sides=6))
        if self._blobs:
            rows = self._placed(np.concatenate(self._blobs))
            rows = self._grounded(rows[~_intrudes(rows, self._kept_clear)])
            cos, sin, zero = np.cos(rows[:, 6]), np.sin(rows[:, 6]), np.zeros(len(rows))
            axes = np.array([[cos, sin, zero], [-sin, cos, zero], [zero, zero, zero + 1.0]]).transpose(2, 0, 1)
            surface = np.column_stack([rows[:, 7], zero + 0.3, rows[:, 8]])
            parts.append(ellipsoids(rows[:, :3], rows[:, 3:6], surface, axes))
        return Primitives.join(parts)

    def _placed(self, rows: Floats) -> Floats:
        rows[:, :2] = self.ground.places(rows[:, 0], rows[:, 1], rows[:, -1] > 0)
        return rows[:, :-1]

    def _grounded(self, rows: Floats) -> Floats:
        rows[:, 2] += self.ground.heights(rows[:, :2])
        return rows


@cached()
def _intrudes(blobs: Floats, footprints: Floats) -> Mask:
    """Return the mask of the clouds that would be in the car (blocking its sensor) or an object."""
    result = np.zeros(len(blobs), np.bool_)
    for i in range(len(blobs)):
        if blobs[i, 2] - blobs[i, 5] >= HEAD_ROOM_M:
            continue
        radius = max(blobs[i, 3], blobs[i, 4])
        for j in range(len(footprints)):
            dx, dy = blobs[i, 0] - footprints[j, 0], blobs[i, 1] - footprints[j, 1]
            cos, sin = np.cos(footprints[j, 4]), np.sin(footprints[j, 4])
            along = max(abs(dx * cos + dy * sin) - footprints[j, 2] / 2, 0.0)
            across = max(abs(dy * cos - dx * sin) - footprints[j, 3] / 2, 0.0)
            if along * along + across * across < radius * radius:
                result[i] = True
                break
    return result
