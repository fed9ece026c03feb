"""Multi-object tracking: constant velocity, one-to-one matching, births and deaths by score.

Each track is a Kalman filter over position and velocity on the ground, with white acceleration (Bar-Shalom, Li,
Kirubarajan, Estimation with Applications to Tracking and Navigation, 6.3); x and y share one covariance, as motion and
measurement are isotropic. The confidence of a track is a score that detections raise and time lowers (Benbarka et al.,
Score refinement for confidence-based 3D multi-object tracking, IROS 2021).
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, fields
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from asca_pillars.base.errors import ConfigError
from asca_pillars.detection.detections import Detection, Detections
from asca_pillars.detection.targets import UNMATCHED, best_assignments
from asca_pillars.geometry.frame_change import FrameChange, is_rigid
from asca_pillars.geometry.overlap import paired_bev_intersection

_DIGITS = 4


class Track(NamedTuple):
    """One tracked box: detection, identity, and velocity along the scan's x and y."""

    track_id: int
    detection: Detection
    vx_mps: float
    vy_mps: float


@dataclass(frozen=True, eq=False)
class Tracks:
    """N tracked boxes of one scan, best first. Iterate for `Track` records."""

    detections: Detections
    """N boxes as they were detected, in the frame of the scan."""
    track_ids: NDArray[np.int64]
    """(N,) identity of each object, the same from scan to scan; numbers are never reused."""
    velocities_mps: NDArray[np.float64]
    """(N, 2) along the scan's x and y: over ground if the tracker gets the vehicle's pose, else relative to it."""

    def __len__(self) -> int:
        return len(self.detections)

    def __iter__(self) -> Iterator[Track]:
        for number, detection, (vx, vy) in zip(
            self.track_ids.tolist(), self.detections, self.velocities_mps.tolist(), strict=True
        ):
            yield Track(number, detection, vx, vy)

    def to_dicts(self) -> list[dict[str, str | float]]:
        """Return `Detections.to_dicts` with `track_id`, `vx_mps` and `vy_mps` in each."""
        return [
            detection
            | {"track_id": track.track_id, "vx_mps": round(track.vx_mps, _DIGITS)}
            | {"vy_mps": round(track.vy_mps, _DIGITS)}
            for detection, track in zip(self.detections.to_dicts(), self, strict=True)
        ]


_Doubles = NDArray[np.float64]
_Integers = NDArray[np.int64]

MEASURED_SIGMA_M = 0.2  # standard deviation of a box's center, on either axis
# Sigma of an object's first velocity per metre of its length, and its bounds, m/s: people are slow and short.
FIRST_SPEED_PER_M, FIRST_SPEED_MPS = 4.0, (2.0, 12.0)
ACCELERATION_MPS2 = 3.0
GATE = 9.21  # squared distance over its variance: 99 % of a track's own detections in the plane
FADE_PER_S = 1.0  # decay of an unconfirmed track's score
MAX_SCORE = 0.98  # upper bound, so that the best tracks end too
MAX_SCAN_GAP_S = 2.0  # largest gap between two scans of one drive
WEAK_SHARE = 0.7
"""Share of the lowest threshold from which on detections continue tracks that better ones began."""
MAX_UNLOOKED_FADE_S = 0.2  # longest decay of a track that the scan before confirmed


@dataclass
class _State:
    """State of T tracks in the fixed frame; rows of the arrays correspond."""

    ids: _Integers
    labels: _Integers
    boxes: _Doubles
    """(T, 7) boxes of the last detections, predicted to the current time."""
    velocities: _Doubles
    """(T, 2)."""
    covariance: _Doubles
    """(T, 3) variance of the position, covariance, variance of the velocity; the same for x and y."""
    scores: _Doubles
    unseen_s: _Doubles

    def __len__(self) -> int:
        return len(self.ids)

    def chosen(self, rows: Any) -> "_State":
        return _State(*(getattr(self, item.name)[rows] for item in fields(self)))

    def joined(self, other: "_State") -> "_State":
        return _State(*(np.concatenate([getattr(self, i.name), getattr(other, i.name)]) for i in fields(self)))


class Tracker:
    """Tracker of multiple objects: assigns identities and velocities to boxes. One per sensor; not thread-safe.

    Detections of low score continue tracks that better ones began: the detector's `score_threshold` should be below
    `birth_score`.

    Args:
        birth_score: a detection that no track takes begins one from this score on; one number, or one for each class
            name. With several classes, those that are not named take the lowest.
        report_score: a track is reported from this score on: at once if it begins there, else after later detections.
        death_score: a track ends below it. Unseen, it loses `FADE_PER_S` of its score per second.
        max_unseen_s: a track that nothing confirmed for so long ends, whatever its score. One that the last scan
            confirmed waits for this scan, if the two are at most `MAX_SCAN_GAP_S` apart.

    Raises:
        ConfigError: a score lies outside 0..1, `birth_score` names no class, or a time is not positive.
    """

    def __init__(
        self,
        *,
        birth_score: float | Mapping[str, float] = 0.3,
        report_score: float = 0.6,
        death_score: float = 0.1,
        max_unseen_s: float = 0.8,
    ) -> None:
        births = dict(birth_score) if isinstance(birth_score, Mapping) else {"": birth_score}
        for name, value in {"report_score": report_score, "death_score": death_score, **births}.items():
            if not 0.0 <= value <= 1.0:
                raise ConfigError(f"{name or 'birth_score'} {value}: a score lies between 0 and 1")
        if not births:
            raise ConfigError("birth_score {}: give one number, or one for at least one class")
        if not max_unseen_s > 0:
            raise ConfigError(f"max_unseen_s {max_unseen_s}: must be positive")
        self._births = births
        self._report_score, self._death_score, self._max_unseen_s = report_score, death_score, max_unseen_s
        self.reset()

    def reset(self) -> None:
        """Drop all tracks, as before another drive; numbers of tracks are not reused."""
        self._state = _empty()
        self._time_s: float | None = None
        self._origin: _Doubles | None = None
        self._next_id = getattr(self, "_next_id", 0)

    def __call__(
        self, detections: Detections, time_s: float, ego_pose: NDArray[np.floating[Any]] | None = None
    ) -> Tracks:
        """Match the detections of one scan with the tracks so far.

        Args:
            detections: of this scan, in its own frame, z up.
            time_s: of this scan, seconds; when it goes back all tracks end.
            ego_pose: (4, 4) from the scan's frame to one that stands still, metres. None: tracked as the car sees it,
                where all that stands still moves.

        Returns:
            The detections that belong to a track which is sure enough, with its identity and velocity.

        Raises:
            ConfigError: `time_s` is not finite, or the pose no rotation and shift.
        """
        pose = _checked_pose(ego_pose)
        if not np.isfinite(time_s):
            raise ConfigError(f"time {time_s}: give seconds")
        if self._time_s is not None and time_s < self._time_s:
            self.reset()
        elapsed = 0.0 if self._time_s is None else time_s - self._time_s
        self._time_s = float(time_s)
        if self._origin is None:
            self._origin = pose[:3, 3].copy()  # far from a map's origin there would be few digits left
        to_world = FrameChange(pose[:3, :3], pose[:3, 3] - self._origin)
        boxes = to_world.boxes(detections.boxes).astype(np.float64)
        scores, labels = detections.scores.astype(np.float64), detections.labels
        self._predict(elapsed)
        row_of = self._match(boxes, labels)
        taken = np.flatnonzero(row_of != UNMATCHED)
        self._update(row_of[taken], boxes[taken], scores[taken])
        births = np.array([self._births.get(name, min(self._births.values())) for name in detections.class_names])
        new = np.flatnonzero((row_of == UNMATCHED) & (scores >= births[labels])) if len(labels) else taken[:0]
        row_of[new] = len(self._state) + np.arange(len(new))
        self._state = self._state.joined(self._born(boxes[new], labels[new], scores[new]))
        reported = np.flatnonzero(row_of != UNMATCHED)
        reported = reported[self._state.scores[row_of[reported]] >= self._report_score]
        rows = row_of[reported]
        velocities = self._state.velocities[rows] @ to_world.axes[:2, :2]
        return Tracks(detections[reported], self._state.ids[rows], velocities)

    def _predict(self, elapsed_s: float) -> None:
        """Predict all tracks, and drop those whose score has faded."""
        state = self._state
        seen = (state.unseen_s == 0) & (elapsed_s <= MAX_SCAN_GAP_S)
        state.scores = state.scores - FADE_PER_S * np.where(seen, min(elapsed_s, MAX_UNLOOKED_FADE_S), elapsed_s)
        state.unseen_s = state.unseen_s + elapsed_s
        state = state.chosen((state.scores >= self._death_score) & (seen | (state.unseen_s <= self._max_unseen_s)))
        state.boxes[:, :2] += elapsed_s * state.velocities
        place, cross, speed = state.covariance.T
        noise = ACCELERATION_MPS2**2 * np.array([elapsed_s**4 / 4, elapsed_s**3 / 2, elapsed_s**2])
        place = place + 2 * elapsed_s * cross + elapsed_s**2 * speed
        state.covariance = np.stack([place, cross + elapsed_s * speed, speed], axis=1) + noise
        self._state = state

    def _match(self, boxes: _Doubles, labels: _Integers) -> _Integers:
        """Return for each detection (N, 7) the row of its track, or UNMATCHED."""
        state = self._state
        if not len(state) or not len(boxes):
            return np.full(len(boxes), UNMATCHED)
        squared = np.square(boxes[:, None, :2] - state.boxes[None, :, :2]).sum(axis=2)
        limit = GATE * (state.covariance[:, 0] + MEASURED_SIGMA_M**2)
        rows, known = np.nonzero((squared < limit) & (labels[:, None] == state.labels))
        affinity = np.zeros(squared.shape)
        first, second = boxes[rows], state.boxes[known]
        shared = paired_bev_intersection(first, second)
        iou = shared / (first[:, 3] * first[:, 4] + second[:, 3] * second[:, 4] - shared)
        affinity[rows, known] = iou + 1.0 - np.sqrt(squared[rows, known] / limit[known])
        holders = best_assignments(affinity)[-1]
        row_of = np.full(len(boxes), UNMATCHED)
        held = np.flatnonzero(holders != UNMATCHED)
        row_of[holders[held]] = held
        return row_of

    def _update(self, rows: _Integers, boxes: _Doubles, scores: _Doubles) -> None:
        """Correct tracks by their matched detections (N, 7)."""
        state = self._state
        place, cross, speed = state.covariance[rows].T
        gain_place = place / (place + MEASURED_SIGMA_M**2)
        gain_speed = cross / (place + MEASURED_SIGMA_M**2)
        off = boxes[:, :2] - state.boxes[rows, :2]
        centers = state.boxes[rows, :2] + gain_place[:, None] * off
        state.velocities[rows] += gain_speed[:, None] * off
        state.boxes[rows] = boxes
        state.boxes[rows, :2] = centers
        kept = 1.0 - gain_place
        state.covariance[rows] = np.stack([kept * place, kept * cross, speed - gain_speed * cross], axis=1)
        state.scores[rows] = np.minimum(1.0 - (1.0 - state.scores[rows]) * (1.0 - scores), MAX_SCORE)
        state.unseen_s[rows] = 0.0

    def _born(self, boxes: _Doubles, labels: _Integers, scores: _Doubles) -> _State:
        count = len(boxes)
        ids = self._next_id + np.arange(count)
        self._next_id += count
        speed = np.clip(FIRST_SPEED_PER_M * boxes[:, 3], *FIRST_SPEED_MPS)
        covariance = np.stack([np.full(count, MEASURED_SIGMA_M**2), np.zeros(count), speed**2], axis=1)
        return _State(ids, labels, boxes, np.zeros((count, 2)), covariance, scores, np.zeros(count))


def _empty() -> _State:
    whole, real = np.zeros(0, np.int64), np.zeros(0)
    return _State(whole, whole, np.zeros((0, 7)), np.zeros((0, 2)), np.zeros((0, 3)), real, real)


def _checked_pose(pose: NDArray[np.floating[Any]] | None) -> _Doubles:
    if pose is None:
        return np.eye(4)
    matrix = np.asarray(pose, np.float64)
    if matrix.shape != (4, 4) or not np.isfinite(matrix).all():
        raise ConfigError(f"ego_pose of shape {matrix.shape}: give a 4x4 matrix of finite numbers, scan to world")
    if not is_rigid(matrix):
        raise ConfigError("ego_pose: must be a rotation and a shift in metres, the last row 0 0 0 1, scan to world")
    return matrix
