"""Everything that has no label: facades, walls, fences, hedges, trees, banks, and clutter that resembles people."""

from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from .config import SceneConfig
from .ground import Ground
from .placement import Occupied
from .primitives import Primitives, cuboids, ellipsoids, prisms
from .shapes.people import bicycle

Floats = npt.NDArray[np.float64]


def _without_intruders(blobs: Floats, footprints: Floats) -> Floats:
    """Foliage without the clouds that would hang into the car (its sensor would see nothing else) or an object."""
    dx, dy = (blobs[:, None, axis] - footprints[None, :, axis] for axis in (0, 1))
    cos, sin = np.cos(footprints[:, 4]), np.sin(footprints[:, 4])
    along = np.maximum(np.abs(dx * cos + dy * sin) - footprints[:, 2] / 2, 0.0)
    across = np.maximum(np.abs(dy * cos - dx * sin) - footprints[:, 3] / 2, 0.0)
    radius = blobs[:, 3:5].max(axis=1, keepdims=True)
    low = (blobs[:, 2] - blobs[:, 5] < 2.2)[:, None]
    return blobs[~((np.hypot(along, across) < radius) & low).any(axis=1)]


@dataclass
class Background:
    """Rows of simple bodies in the LiDAR frame, heights still above the local ground."""

    rng: np.random.Generator
    config: SceneConfig
    ground: Ground
    occupied: Occupied
    kind: str
    _kept_clear: Floats = field(init=False)  # footprints of the car and of the objects
    _bodies: list[Primitives] = field(default_factory=list)
    _boxes: list[tuple[float, ...]] = field(default_factory=list)
    _posts: list[tuple[float, ...]] = field(default_factory=list)
    _blobs: list[tuple[float, ...]] = field(default_factory=list)  # x y z rx ry rz yaw reflectance density

    def __post_init__(self) -> None:
        self._kept_clear = self.occupied.rows[: self.occupied.count].copy()

    def primitives(self) -> Primitives:
        """All bodies, set on the ground."""
        parts = list(self._bodies)
        if self._boxes:
            rows = np.array(self._boxes)
            rows[:, 2] += self.ground.heights(rows[:, :2])
            parts.append(cuboids(rows))
        if self._posts:
            rows = np.array(self._posts)
            rows[:, 2] += self.ground.heights(rows[:, :2])
            parts.append(prisms(rows, sides=6))
        if self._blobs:
            rows = _without_intruders(np.array(self._blobs), self._kept_clear)
            rows[:, 2] += self.ground.heights(rows[:, :2])
            cos, sin, zero = np.cos(rows[:, 6]), np.sin(rows[:, 6]), np.zeros(len(rows))
            axes = np.stack(
                [np.stack([cos, sin, zero], 1), np.stack([-sin, cos, zero], 1), np.stack([zero, zero, zero + 1], 1)], 1
            )
            surface = np.column_stack([rows[:, 7], zero + 0.3, rows[:, 8]])
            parts.append(ellipsoids(rows[:, :3], rows[:, 3:6], surface, axes))
        return Primitives.join(parts)

    def line_street(self) -> None:
        """Both sides of both roads, and what stands far behind."""
        half, pavement = self.ground.half_width_m, self.ground.pavement_m
        for side in (1.0, -1.0):
            self._line(side, half + pavement, -85.0, 85.0, cross=False)
            if self.ground.cross_half_m > 0:
                edge = self.ground.cross_half_m + pavement
                self._line(side, edge, half + pavement + 5.0, 70.0, cross=True)
                self._line(side, edge, -70.0, -half - pavement - 5.0, cross=True)
        self._far_things()

    def _to_lidar(self, along: float, across: float, yaw: float, cross: bool) -> tuple[float, float, float]:
        return (self.ground.cross_to_lidar if cross else self.ground.to_lidar)(along, across, yaw)

    def _near_junction(self, start: float, end: float) -> bool:
        reach = self.ground.cross_half_m + self.ground.pavement_m + 1.0
        return (
            self.ground.cross_half_m > 0
            and start < self.ground.cross_u_m + reach
            and end > self.ground.cross_u_m - reach
        )

    def _line(self, side: float, edge: float, start: float, end: float, cross: bool) -> None:
        kinds, weights = {
            "residential": (("building", "hedge", "wall", "fence", "trees", "open"), (0.33, 0.17, 0.14, 0.12, 0.16, 0.08)),
            "urban": (("building", "wall", "fence", "trees", "open"), (0.58, 0.10, 0.08, 0.16, 0.08)),
            "rural": (("trees", "wood", "hedge", "fence", "rail", "open", "building"), (0.24, 0.30, 0.12, 0.08, 0.12, 0.08, 0.06)),
            "campus": (("building", "trees", "hedge", "open", "wall"), (0.40, 0.25, 0.12, 0.15, 0.08)),
        }[self.kind]  # fmt: skip
        rng = self.rng
        u = start
        setback = rng.uniform(0.0, 5.0) if self.kind != "urban" else rng.uniform(0.0, 1.5)
        while u < end:
            length = min(float(rng.uniform(6.0, 24.0)), end - u)
            if not cross and self._near_junction(u, u + length):
                u += 2.0
                continue
            kind = str(rng.choice(kinds, p=np.array(weights) / sum(weights)))
            away = edge + 0.3 + (max(setback + rng.normal(0, 0.7), 0.0) if kind in ("building", "trees") else 0.0)
            getattr(self, f"_{kind}")(u, length, side, away, cross)
            if kind not in ("building", "wood") and rng.random() < 0.92:  # a second row behind it
                behind = away + rng.uniform(5.0, 16.0)
                if rng.random() < 0.5 and self.kind != "rural":
                    self._building(u, length, side, behind, cross)
                else:
                    self._wood(u, length, side, behind, cross)
            u += length + (0.0 if rng.random() < 0.6 else rng.uniform(0.5, 4.0))

    def _slab(self, along: float, across: float, length: float, width: float, height: float, z: float,
              surface: tuple[float, float, float], cross: bool, claim: bool = True) -> bool:  # fmt: skip
        x, y, yaw = self._to_lidar(along, across, 0.0, cross)
        # Pieces of one wall touch, on a bend they even overlap a little.
        if claim and not self.occupied.take(x, y, 0.9 * length, width, yaw):
            return False
        self._boxes.append((x, y, z, length, width, height, yaw, *surface))
        return True

    def _building(self, u: float, length: float, side: float, away: float, cross: bool) -> None:
        """A core with recessed windows behind pillars and a plinth, sometimes steps, a bay or a balcony."""
        rng = self.rng
        depth, height = float(rng.uniform(5.0, 10.0)), float(rng.uniform(3.2, 9.0))
        recess = float(rng.uniform(0.08, 0.35))
        stone = (float(rng.uniform(0.12, 0.5)), 0.3, 0.0)
        glass = (float(rng.uniform(0.03, 0.25)), 2.0, float(rng.choice([0.0, 0.0, 0.1])))
        pieces = max(int(length // 8.0), 1)
        for piece in range(pieces):
            part = length / pieces
            middle = u + (piece + 0.5) * part
            if not self._slab(middle, side * (away + recess + depth / 2), part, depth, height, -1.0, glass, cross):
                continue
            step = float(rng.uniform(1.8, 3.4))
            pillar = float(rng.uniform(0.35, 0.75)) * step
            plinth = float(rng.uniform(0.5, 1.2))
            front = side * (away + recess / 2)
            self._slab(middle, front, part, recess, plinth + 1.0, -1.0, stone, cross, claim=False)
            lintel = float(rng.uniform(2.1, 2.9))
            self._slab(middle, front, part, recess, height - lintel - 1.0, lintel, stone, cross, claim=False)
            for along in np.arange(middle - part / 2 + pillar / 2, middle + part / 2, step):
                self._slab(along, front, pillar, recess + 0.02, height - 1.0, -1.0, stone, cross, claim=False)
            extra = rng.random()
            if extra < 0.25:
                self._slab(
                    middle + rng.uniform(-2, 2),
                    side * (away - 0.5),
                    rng.uniform(1.2, 2.2),
                    0.9,
                    0.35,
                    -0.2,
                    stone,
                    cross,
                )
            elif extra < 0.4:
                self._slab(
                    middle + rng.uniform(-2, 2),
                    side * (away - 0.45),
                    rng.uniform(1.5, 3.0),
                    0.9,
                    1.0,
                    2.4,
                    stone,
                    cross,
                    False,
                )
            if rng.random() < 0.5:  # a drainpipe
                x, y, _ = self._to_lidar(middle + rng.uniform(-part, part) / 2, side * (away - 0.08), 0.0, cross)
                self._posts.append((x, y, -0.1, 5.0, 0.05, 0.05, 0.3))

    def _wall(self, u: float, length: float, side: float, away: float, cross: bool) -> None:
        height, thick = float(self.rng.uniform(0.5, 2.3)), float(self.rng.uniform(0.2, 0.4))
        stone = (float(self.rng.uniform(0.12, 0.45)), 0.3, 0.0)
        for along in np.arange(u + 2.0, u + length - 1.9, 4.0):
            if self._slab(along, side * away, 4.0, thick, height + 0.4, -0.4, stone, cross) and self.rng.random() < 0.4:
                self._slab(along + 2.0, side * away, 0.4, thick + 0.12, height + 0.6, -0.4, stone, cross, claim=False)

    def _fence(self, u: float, length: float, side: float, away: float, cross: bool) -> None:
        height = float(self.rng.uniform(0.8, 2.0))
        board = (float(self.rng.uniform(0.1, 0.45)), 0.4, float(self.rng.choice([0.1, 0.45, 0.75, 0.9])))
        for along in np.arange(u + 1.2, u + length - 1.1, 2.4):
            if self._slab(along, side * away, 2.4, 0.05, height - 0.1, 0.1, board, cross):
                self._slab(
                    along + 1.2, side * away, 0.1, 0.1, height + 0.3, -0.2, (*board[:2], 0.0), cross, claim=False
                )

    def _rail(self, u: float, length: float, side: float, away: float, cross: bool) -> None:
        """A guard rail on posts."""
        steel = (float(self.rng.uniform(0.2, 0.5)), 0.8, 0.0)
        for along in np.arange(u + 2.0, u + length - 1.9, 4.0):
            if self._slab(along, side * (away - 0.2), 4.0, 0.08, 0.31, 0.42, steel, cross):
                self._slab(along + 2.0, side * (away - 0.1), 0.1, 0.1, 0.9, -0.2, steel, cross, claim=False)

    def _hedge(self, u: float, length: float, side: float, away: float, cross: bool) -> None:
        height, thick = float(self.rng.uniform(0.7, 2.4)), float(self.rng.uniform(0.5, 1.2))
        green = float(self.rng.uniform(0.2, 0.45))
        for along in np.arange(u + 0.7, u + length - 0.6, 1.3):
            x, y, yaw = self._to_lidar(along, side * (away + thick / 2), 0.0, cross)
            if self.occupied.take(x, y, 1.3, thick, yaw, -0.05):
                size = height * self.rng.uniform(0.9, 1.1) / 2
                self._blobs.append(
                    (x, y, size * 0.9, 1.0, thick * 0.7, size * 1.15, yaw, green, self.rng.uniform(3.0, 8.0))
                )

    def _trees(self, u: float, length: float, side: float, away: float, cross: bool) -> None:
        for along in np.arange(u + 2.0, u + length, self.rng.uniform(3.5, 9.0)):
            self._tree(along, side * (away + self.rng.uniform(0.3, 3.0)), cross)
            if self.rng.random() < 0.6:
                self._shrub(along + self.rng.normal(0, 2.0), side * (away + self.rng.uniform(0.2, 4.0)), cross)

    def _wood(self, u: float, length: float, side: float, away: float, cross: bool) -> None:
        """A dense edge of trees and undergrowth, as it closes most views in KITTI."""
        for along in np.arange(u, u + length, 1.7):
            self._shrub(along, side * (away + self.rng.uniform(0.0, 2.5)), cross, tall=True)
            if self.rng.random() < 0.4:
                self._tree(along, side * (away + self.rng.uniform(1.0, 5.0)), cross)

    def _open(self, u: float, length: float, side: float, away: float, cross: bool) -> None:
        if self.rng.random() < 0.5:
            self._tree(u + length / 2, side * (away + self.rng.uniform(1.0, 8.0)), cross)

    def _tree(self, along: float, across: float, cross: bool) -> None:
        rng = self.rng
        x, y, yaw = self._to_lidar(along, across, 0.0, cross)
        radius = float(rng.uniform(0.07, 0.32))
        if not self.occupied.take(x, y, 2 * radius, 2 * radius, yaw):
            return
        trunk = float(rng.uniform(1.2, 3.5))
        self._posts.append((x, y, -0.3, trunk + 2.0, radius * 1.15, radius * 0.7, float(rng.uniform(0.1, 0.4))))
        density = float(np.exp(rng.uniform(*np.log(self.config.crown_density_per_m))))
        crown = float(rng.uniform(1.0, 3.0))
        green = float(rng.uniform(0.22, 0.55))
        self._foliage(x, y, trunk + 0.9 * crown, crown, int(rng.integers(6, 13)), green, density)

    def _foliage(
        self, x: float, y: float, z: float, radius: float, blobs: int, reflectance: float, density: float
    ) -> None:
        """Overlapping clouds of leaves around (x, y, z): no two crowns alike, none a ball."""
        rng = self.rng
        offset = rng.normal(0.0, 0.5, (blobs, 3)) * radius * (1.0, 1.0, 0.75)
        size = radius * rng.uniform(0.18, 0.75, (blobs, 3))
        turn = rng.uniform(0.0, 3.1, blobs)
        thick = density * np.exp(rng.normal(0.0, 0.6, blobs))
        for (dx, dy, dz), radii, yaw, d in zip(offset, size, turn, thick, strict=True):
            self._blobs.append((x + dx, y + dy, max(z + dz, 0.3 * radii[2]), *radii, yaw, reflectance, d))

    def _shrub(self, along: float, across: float, cross: bool, tall: bool = False) -> None:
        rng = self.rng
        x, y, yaw = self._to_lidar(along, across, 0.0, cross)
        size = rng.uniform(0.6, 1.8, 2) if tall else rng.uniform(0.3, 1.0, 2)
        height = float(rng.uniform(1.0, 2.6) if tall else rng.uniform(0.25, 1.0))
        if self.occupied.take(x, y, size[0], size[1], yaw):
            density = float(np.exp(rng.uniform(np.log(0.6), np.log(4.5))))
            self._foliage(x, y, 0.5 * height, 0.9 * float(max(height, size.max())), int(rng.integers(3, 7)),
                          float(rng.uniform(0.22, 0.55)), density)  # fmt: skip

    def _far_things(self) -> None:
        """Houses and woods that close the view at the ends of the street and far to its sides."""
        rng = self.rng
        for _ in range(int(rng.integers(14, 30))):
            u, v = rng.uniform(-80, 80), rng.choice([-1, 1]) * rng.uniform(self.ground.half_width_m + 18, 70)
            if self._near_junction(u - 8, u + 8):
                continue
            if rng.random() < 0.45:
                self._building(u, float(rng.uniform(8, 20)), float(np.sign(v)), abs(v), False)
            else:
                self._wood(u, float(rng.uniform(6, 20)), float(np.sign(v)), abs(v), False)

    def scatter(self) -> None:
        """Posts, signs, lamps, bins, bollards, cabinets, shrubs: much of it the size of a person."""
        rng, half, pavement = self.rng, self.ground.half_width_m, self.ground.pavement_m
        for _ in range(rng.poisson(rng.uniform(*self.config.clutter) * 1.6)):
            u = float(rng.uniform(-78, 78))
            side = 1.0 if rng.random() < 0.5 else -1.0
            v = side * (half + (rng.uniform(0.25, 0.7) if rng.random() < 0.4 else rng.uniform(0.3, pavement + 6.0)))
            if self._near_junction(u, u):
                continue
            self._one_thing(u, v)

    def _one_thing(self, u: float, v: float) -> None:
        rng = self.rng
        x, y, yaw = self.ground.to_lidar(u, v)
        what = rng.random()
        bright = float(rng.uniform(0.1, 0.6))
        if what < 0.30:  # lamp posts, sign posts, traffic lights
            radius = float(rng.uniform(0.035, 0.12))
            if not self.occupied.take(x, y, 2 * radius, 2 * radius, yaw):
                return
            height = float(rng.uniform(2.2, 6.0))
            self._posts.append((x, y, -0.2, height, radius, radius * 0.8, bright))
            plate = rng.random()
            if plate < 0.5:
                size = float(rng.uniform(0.4, 0.9))
                z = float(rng.uniform(1.4, 2.6))
                self._boxes.append((x, y, z, 0.04, size, size, yaw + rng.normal(0, 0.3), 0.8, 0.4, 0.0))
            elif plate < 0.65:
                self._boxes.append((x, y, rng.uniform(1.8, 2.6), 0.25, 0.3, 0.9, yaw, 0.15, 0.4, 0.0))
        elif what < 0.42:  # bollards
            radius = float(rng.uniform(0.04, 0.16))
            for k in range(int(rng.integers(1, 6))):
                x, y, yaw = self.ground.to_lidar(u + 1.5 * k, v)
                if self.occupied.take(x, y, 2 * radius, 2 * radius, yaw):
                    self._posts.append((x, y, -0.2, rng.uniform(0.8, 1.3), radius, radius, bright))
        elif what < 0.60:  # cabinets, bins, post boxes, stones, benches
            size = (float(rng.uniform(0.25, 1.4)), float(rng.uniform(0.25, 0.6)))
            if self.occupied.take(x, y, *size, yaw):
                self._boxes.append(
                    (x, y, -0.2, *size, rng.uniform(0.6, 1.9), yaw + rng.normal(0, 0.1), bright, 0.5, 0.0)
                )
        elif what < 0.72:  # columns of a person's height, with or without a head
            width, height = float(rng.uniform(0.25, 0.7)), float(rng.uniform(1.0, 2.1))
            if self.occupied.take(x, y, width, width, yaw):
                self._posts.append((x, y, -0.2, 0.85 * height, width / 2, width * rng.uniform(0.2, 0.5), bright))
                self._blobs.append((x, y, 0.88 * height, 0.12, 0.12, 0.13 * height, 0.0, bright, 0.0))
        elif what < 0.77:  # bicycles without a rider, which KITTI does not label
            for k in range(int(rng.integers(1, 5))):
                x, y, yaw = self.ground.to_lidar(u + 0.7 * k, v, np.pi / 2 + float(rng.normal(0, 0.15)))
                if self.occupied.take(x, y, 1.75, 0.55, yaw):
                    z = float(self.ground.heights((x, y))[0])
                    self._bodies.append(bicycle(rng, float(rng.uniform(1.6, 1.85))).placed(x, y, z, yaw))
        elif what < 0.94:
            self._shrub(u, v, False, tall=bool(rng.random() < 0.35))
        else:
            self._tree(u, v, False)
