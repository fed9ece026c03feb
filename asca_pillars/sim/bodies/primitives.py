"""Geometric primitives of a scene: triangles, ellipsoids and limbs, with their surfaces.

Their shapes are changed at random, against overfitting to exact ones: scale per axis, smooth warps, dark patches.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Self

import numpy as np
from numpy.typing import ArrayLike

from asca_pillars.geometry.boxes import Floats, Mask

BACKGROUND = -1  # owner of unlabelled primitives

_CUBE_FACES = np.array(
    [[0, 1, 5, 4], [1, 2, 6, 5], [2, 3, 7, 6], [3, 0, 4, 7], [4, 5, 6, 7]]  # sides, top; the bottom is never seen
)
_QUAD = np.array([0, 1, 2, 0, 2, 3])  # corners of its two triangles
_CUBE = _CUBE_FACES[:, _QUAD].ravel()


@dataclass(frozen=True)
class Surface:
    """Reflection of a laser by a material.

    Attributes:
        reflectance: 0..1 at normal incidence.
        gloss: the returned reflectance falls with cos(incidence) ** gloss; 0 is matte.
        transparency: share of rays that pass through (triangles only).
        density_per_m: density of a cloud (ellipsoids only); 0 is solid.
    """

    reflectance: float
    gloss: float = 0.2
    transparency: float = 0.0
    density_per_m: float = 0.0

    @property
    def row(self) -> Floats:
        """(3,) reflectance, gloss, transparency, as in the surface table of triangles."""
        return np.array([self.reflectance, self.gloss, self.transparency])


@dataclass(frozen=True)
class Primitives:
    """Triangles (T,3,3) and ellipsoids (E): metres, LiDAR frame once placed."""

    triangles: Floats  # (T,3,3)
    triangle_surface: Floats  # (T,3) reflectance, gloss, transparency
    centers: Floats  # (E,3)
    unit_from_world: Floats  # (E,3,3): |unit_from_world (p - center)| = 1 on the surface
    ellipsoid_surface: Floats  # (E,3) reflectance, gloss, density per metre

    @classmethod
    def join(cls, parts: Sequence[Self]) -> Self:
        """Return all primitives of the parts, in their order."""
        if not parts:
            return cls(np.zeros((0, 3, 3)), np.zeros((0, 3)), np.zeros((0, 3)), np.zeros((0, 3, 3)), np.zeros((0, 3)))
        return cls(
            np.concatenate([part.triangles for part in parts]),
            np.concatenate([part.triangle_surface for part in parts]),
            np.concatenate([part.centers for part in parts]),
            np.concatenate([part.unit_from_world for part in parts]),
            np.concatenate([part.ellipsoid_surface for part in parts]),
        )

    def placed(self, x_m: float, y_m: float, z_m: float, yaw_rad: float) -> "Primitives":
        """Return the body rotated about +z and translated."""
        cos, sin = np.cos(yaw_rad), np.sin(yaw_rad)
        rotation = np.array([[cos, -sin, 0.0], [sin, cos, 0.0], [0.0, 0.0, 1.0]])
        shift = np.array([x_m, y_m, z_m])
        return Primitives(
            rotated(self.triangles, rotation) + shift,
            self.triangle_surface,
            self.centers @ rotation.T + shift,
            rotated(self.unit_from_world, rotation),
            self.ellipsoid_surface,
        )


def rotated(vectors: Floats, rotation: Floats) -> Floats:
    """Rotate vectors (..., 3), in metres or unitless, by a rotation (3, 3)."""
    # One product: NumPy would multiply a stack of matrices one by one.
    return (vectors.reshape(-1, 3) @ rotation.T).reshape(vectors.shape)


def _only_triangles(triangles: Floats, surface: Floats) -> Primitives:
    return Primitives(triangles, surface, np.zeros((0, 3)), np.zeros((0, 3, 3)), np.zeros((0, 3)))


def quads(corners: ArrayLike, surface: Surface | Floats) -> Primitives:
    """Return flat quadrilaterals: corners (...,4,3) in order around each, metres.

    One surface for all, or a table (...,3) of each one's reflectance, gloss, transparency.
    """
    corners = np.asarray(corners, float).reshape(-1, 4, 3)
    table = surface.row if isinstance(surface, Surface) else surface
    table = np.broadcast_to(table, (len(corners), 3)) if table.ndim == 1 else table.reshape(-1, 3)
    return _only_triangles(corners.take(_QUAD, axis=1).reshape(-1, 3, 3), np.repeat(table, 2, axis=0))


def cuboids(rows: ArrayLike) -> Primitives:
    """Return boxes without a bottom, 10 triangles each.

    Rows (N,10) are x, y, bottom z, length, width, height, in metres, yaw in radians, and a surface's reflectance,
    gloss, transparency.
    """
    rows = np.asarray(rows, float).reshape(-1, 10)
    half = rows[:, 3:5] / 2
    sign = np.array([[1.0, 1.0], [-1.0, 1.0], [-1.0, -1.0], [1.0, -1.0]])
    local = sign[None] * half[:, None]  # (N,4,2)
    cos, sin = np.cos(rows[:, 6, None]), np.sin(rows[:, 6, None])
    corners = np.empty((len(rows), 8, 3))
    corners[:, :4, 0] = rows[:, 0, None] + local[..., 0] * cos - local[..., 1] * sin
    corners[:, :4, 1] = rows[:, 1, None] + local[..., 0] * sin + local[..., 1] * cos
    corners[:, 4:, :2] = corners[:, :4, :2]
    corners[:, :4, 2], corners[:, 4:, 2] = rows[:, 2, None], (rows[:, 2] + rows[:, 5])[:, None]
    return _only_triangles(corners.take(_CUBE, axis=1).reshape(-1, 3, 3), np.repeat(rows[:, 7:10], 10, axis=0))


def prisms(rows: ArrayLike, sides: int = 8) -> Primitives:
    """Return round posts of 2 * `sides` triangles each, open at both ends (a lid is thinner than a laser's footprint).

    Rows (N,9) are x, y, bottom z, height, radius at the foot, radius at the top, in metres, reflectance, and the
    lean of the top along x and y per metre of height; these two may be left out (N,7).
    """
    rows = np.atleast_2d(np.asarray(rows, float))
    lean = rows[:, 7:9] if rows.shape[1] == 9 else np.zeros((len(rows), 2))
    angle = np.arange(sides) * (2 * np.pi / sides)
    ring = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    foot = np.concatenate(
        [rows[:, None, :2] + ring * rows[:, 4, None, None], np.broadcast_to(rows[:, None, 2:3], (len(rows), sides, 1))],
        axis=-1,
    )
    top = np.concatenate(
        [
            (rows[:, :2] + lean * rows[:, 3, None])[:, None] + ring * rows[:, 5, None, None],
            np.broadcast_to((rows[:, 2] + rows[:, 3])[:, None, None], (len(rows), sides, 1)),
        ],
        axis=-1,
    )
    corners = np.stack([foot, np.roll(foot, -1, 1), np.roll(top, -1, 1), top], axis=2).reshape(-1, 4, 3)
    surface = np.zeros((len(rows), 3))
    surface[:, 0], surface[:, 1] = rows[:, 6], 0.3
    return _only_triangles(corners.take(_QUAD, axis=1).reshape(-1, 3, 3), np.repeat(surface, 2 * sides, axis=0))


def ellipsoids(centers: ArrayLike, radii: ArrayLike, surface: Floats, axes: ArrayLike | None = None) -> Primitives:
    """Return ellipsoids: centers (E,3), radii (E,3) along the rows of `axes` (E,3,3; default: x, y, z), metres.

    Surface (E,3) is reflectance, gloss, density per metre (0 is solid).
    """
    centers = np.asarray(centers, float).reshape(-1, 3)
    radii = np.asarray(radii, float).reshape(-1, 3)
    turned = np.broadcast_to(np.eye(3), (len(centers), 3, 3)) if axes is None else np.asarray(axes, float)
    return Primitives(
        np.zeros((0, 3, 3)), np.zeros((0, 3)), centers, turned / radii[:, :, None], surface.reshape(-1, 3)
    )


def limbs(
    start: ArrayLike, end: ArrayLike, radii: ArrayLike, surface: Floats, side: tuple[float, float, float]
) -> Primitives:
    """Return long ellipsoids from `start` to `end` (N,3), with radii (N,2): along `side` and across it; in metres."""
    start, end = np.asarray(start, float), np.asarray(end, float)
    radii = np.asarray(radii, float)
    along = end - start
    length = _lengths(along)
    along = along / length
    sideways = np.asarray(side) - along * (along @ np.asarray(side))[:, None]
    # A limb that points sideways needs another second axis.
    flat = _lengths(sideways)[:, 0] < 0.2
    if flat.any():
        sideways[flat] = np.cross(along[flat], (0.0, 0.0, 1.0)) + 1e-9
    sideways /= _lengths(sideways)
    axes = np.empty((len(along), 3, 3))
    axes[:, 0], axes[:, 1] = along, sideways
    (ax, ay, az), (sx, sy, sz) = along.T, sideways.T
    axes[:, 2, 0], axes[:, 2, 1], axes[:, 2, 2] = ay * sz - az * sy, az * sx - ax * sz, ax * sy - ay * sx
    # Joints overlap, so that a body has no gaps where its ellipsoids taper.
    half = length[:, 0] / 2 + 0.5 * radii.mean(axis=1)
    return ellipsoids((start + end) / 2, np.column_stack([half, radii]), surface, axes)


def _lengths(vectors: Floats) -> Floats:
    """Return the lengths (N,1) of vectors (N,3)."""
    return np.sqrt((vectors * vectors).sum(axis=1, keepdims=True))


# From, to, radius sideways, radius across, surface.
Limb = tuple[ArrayLike, ArrayLike, float, float, Floats]


def draw_cloth(rng: np.random.Generator, n: int, dark_share: float = 0.1) -> Floats:
    """Return (n,3) surfaces: skin and most cloth are bright in the near infrared, some cloth is black."""
    dark = rng.random(n) < dark_share
    value = np.where(dark, rng.uniform(0.003, 0.06, n), rng.uniform(0.12, 0.8, n))
    return np.column_stack([value, rng.uniform(0.05, 0.4, n), np.zeros(n)])


def draw_skin(rng: np.random.Generator) -> Floats:
    """Return (3,) reflectance, gloss, density of bare skin."""
    return np.array([rng.uniform(0.3, 0.55), 0.2, 0.0])


def jointed(rows: list[Limb]) -> Primitives:
    """Return limbs as ellipsoids."""
    starts, ends, sideways, across, surfaces = zip(*rows, strict=True)
    radii = np.column_stack([sideways, across])
    return limbs(np.array(starts), np.array(ends), radii, np.array(surfaces), (0.0, 1.0, 0.0))


_WAVES = 2
_WAVELENGTH_M = 1.0, 5.0
_FEET_M = 0.5  # displacements fade below it towards the ground
_PATCH_M = 0.15, 0.45


def scaled(body: Primitives, factors: ArrayLike) -> Primitives:
    """Return the body scaled about its origin by `factors` (3,) along x, y and z."""
    by = np.asarray(factors, float)
    return replace(
        body, triangles=body.triangles * by, centers=body.centers * by, unit_from_world=body.unit_from_world / by
    )


def warped(rng: np.random.Generator, body: Primitives, most_m: float) -> Primitives:
    """Return the body with every point displaced by a smooth random field, by at most `most_m` along each axis.

    The field is a sum of a few waves that are longer than a limb and mostly longer than a person. Positions
    are displaced, ellipsoids keep their shape.
    """
    direction = rng.standard_normal((_WAVES, 3))
    length = np.exp(rng.uniform(np.log(_WAVELENGTH_M[0]), np.log(_WAVELENGTH_M[1]), _WAVES))
    number = 2 * np.pi * direction / (np.linalg.norm(direction, axis=1) * length)[:, None]
    phase = rng.uniform(0.0, 2 * np.pi, _WAVES)
    shift = rng.uniform(-most_m / _WAVES, most_m / _WAVES, (_WAVES, 3))

    def moved(points: Floats) -> Floats:
        flat = points.reshape(-1, 3)
        away = np.sin(flat @ number.T + phase) @ shift
        away[:, 2] *= np.minimum(np.abs(flat[:, 2]) / _FEET_M, 1.0)
        away += flat
        return away.reshape(points.shape)

    return replace(body, triangles=moved(body.triangles), centers=moved(body.centers))


def darkened(rng: np.random.Generator, body: Primitives) -> Primitives:
    """Return the body with a patch without returns about a random point of it: black, wet or at grazing incidence."""
    middles = np.concatenate([body.triangles.mean(axis=1), body.centers])
    if not len(middles):
        return body
    around = middles[int(rng.integers(len(middles)))]
    dark = np.linalg.norm(middles - around, axis=1) < rng.uniform(*_PATCH_M)
    first = len(body.triangles)

    def without(surface: Floats, which: Mask) -> Floats:
        surface = surface.copy()
        surface[which, 0] = 0.0
        return surface

    return replace(
        body,
        triangle_surface=without(body.triangle_surface, dark[:first]),
        ellipsoid_surface=without(body.ellipsoid_surface, dark[first:]),
    )
