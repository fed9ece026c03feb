"""Identities and velocities: of made-up objects whose ways are known."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from asca_deploy import find_bundle
from asca_deploy.manifest import load_bundle
from asca_deploy.open_model import track_thresholds
from asca_deploy.tracker import WEAK_SHARE, Tracker
from asca_pillars.base.errors import ConfigError
from asca_pillars.detection.detections import Detections

NAMES = ("Car", "Pedestrian")
CAR, PERSON = (4.0, 1.8, 1.5), (0.8, 0.6, 1.7)


def found(*boxes: tuple[float, float, float, int]) -> Detections:
    """x, y, score, class of each."""
    rows = [[x, y, 0.0, *(CAR if label == 0 else PERSON), 0.0] for x, y, _, label in boxes]
    return Detections(
        np.array(rows, np.float32).reshape(-1, 7),
        np.array([box[2] for box in boxes], np.float32),
        np.array([box[3] for box in boxes], np.int64),
        NAMES,
    )


def pose(x: float = 0.0, y: float = 0.0, yaw: float = 0.0) -> np.ndarray:
    cos, sin = np.cos(yaw), np.sin(yaw)
    return np.array([[cos, -sin, 0, x], [sin, cos, 0, y], [0, 0, 1, 0], [0, 0, 0, 1.0]])


def test_velocity_and_identity_of_an_oncoming_car() -> None:
    tracker = Tracker()
    ids = set()
    for step in range(20):
        tracks = tracker(found((50 - step, 2.0, 0.9, 0)), step / 10)
        ids |= set(tracks.track_ids.tolist())
    assert ids == {0}
    assert tracks.velocities_mps[0] == pytest.approx([-10, 0], abs=0.2)
    (track,) = tracks
    assert track.detection.x_m == 31.0 and track.vx_mps == tracks.velocities_mps[0, 0]


def test_far_from_a_map_s_origin_velocities_are_as_exact_as_near_it() -> None:
    """Poses of a map's coordinates have hundreds of kilometres, of which a float32 holds no more than centimetres."""
    speeds = []
    for origin in ((0.0, 0.0), (456_789.123, 5_432_109.876)):
        tracker = Tracker()
        for step in range(10):
            moved = pose(origin[0] + 0.7 * step, origin[1] + 0.2 * step, 0.3)
            tracks = tracker(found((30 - 0.3 * step, 2.0, 0.9, 0)), step / 10, moved)
        speeds.append(tracks.velocities_mps)
    assert np.abs(speeds[0]).max() > 1
    np.testing.assert_allclose(speeds[1], speeds[0], atol=1e-4)


def test_cars_that_pass_each_other_keep_their_identities() -> None:
    tracker = Tracker()
    for step in range(40):
        t = step / 10
        tracks = tracker(found((10 + 10 * t, 1.3, 0.8, 0), (50 - 10 * t, -1.3, 0.9, 0)), t)
        by_lane = {round(track.detection.y_m, 1): track.track_id for track in tracks}
        assert by_lane == {1.3: 0, -1.3: 1}
    assert tracks.velocities_mps[:, 0] == pytest.approx([10, -10], abs=0.3)


def test_a_person_does_not_take_the_track_of_a_car() -> None:
    tracker = Tracker()
    tracker(found((10, 0, 0.9, 0)), 0.0)
    assert tracker(found((10, 0, 0.9, 1)), 0.1).track_ids.tolist() == [1]


@pytest.mark.parametrize(("aside_m", "track_id"), [(0.6, 0), (0.9, 1)])
def test_a_detection_beyond_the_gate_is_somebody_else(aside_m: float, track_id: int) -> None:
    """A person stands still: 99 % of the detections are within 0.8 m of what the last two seconds predict."""
    tracker = Tracker()
    for step in range(20):
        tracker(found((10, 0, 0.9, 1)), step / 10)
    assert tracker(found((10, aside_m, 0.9, 1)), 2.0).track_ids.tolist() == [track_id]


def test_a_track_survives_a_gap_and_ends_after_a_longer_one() -> None:
    tracker = Tracker(max_unseen_s=0.5)
    for step in range(10):
        tracker(found((10 + step, 0, 0.9, 0)), step / 10)
    for step in range(10, 14):
        assert len(tracker(found(), step / 10)) == 0
    assert tracker(found((24, 0, 0.9, 0)), 1.4).track_ids.tolist() == [0], "found where it should be by then"
    for step in range(15, 22):
        tracker(found(), step / 10)
    assert tracker(found((32, 0, 0.9, 0)), 2.2).track_ids.tolist() == [1]


def test_at_one_scan_per_second_what_every_scan_finds_is_one_track() -> None:
    tracker, weak = Tracker(), Tracker(birth_score=0.4)
    for step in range(5):
        assert tracker(found((10, 0, 0.9, 0)), float(step)).track_ids.tolist() == [0]
        assert weak(found((10, 0, 0.55, 0)), float(step)).track_ids.tolist() == ([0] if step else [])
    tracker(found(), 5.0)
    assert tracker(found((10, 0, 0.9, 0)), 6.0).track_ids.tolist() == [1], "it was looked for, and not found"


def test_births_and_reports_by_score() -> None:
    tracker = Tracker(birth_score={"Car": 0.3, "Pedestrian": 0.5}, report_score=0.4)
    weak = found((10, 0, 0.35, 0), (10, 9, 0.4, 1))
    assert len(tracker(weak, 0.0)) == 0, "the car waits for a second look, the person is not believed"
    second = tracker(weak, 0.1)
    assert second.detections.names == ["Car"] and second.track_ids.tolist() == [0]
    low = tracker(found((10, 0, 0.15, 0)), 0.2)
    assert low.track_ids.tolist() == [0], "a weak box carries a track on"
    assert len(Tracker(birth_score=0.3)(found((10, 0, 0.15, 0)), 0.0)) == 0


@given(st.floats(-np.pi, np.pi), st.floats(-20, 20), st.floats(-1, 1))
def test_what_stands_still_has_no_velocity_over_ground_however_the_car_moves(
    yaw: float, speed: float, turn: float
) -> None:
    tracker = Tracker()
    place = np.array([1e5 + 12.0, -3e5 + 5.0])  # far from a map's origin
    for step in range(15):
        t = step / 10
        heading = yaw + turn * t
        ego = np.array([1e5 + speed * t, -3e5])
        cos, sin = np.cos(heading), np.sin(heading)
        x, y = np.array([[cos, sin], [-sin, cos]]) @ (place - ego)
        tracks = tracker(found((x, y, 0.9, 0)), t, pose(ego[0], ego[1], heading))
    assert tracks.track_ids.tolist() == [0]
    assert tracks.velocities_mps[0] == pytest.approx([0, 0], abs=0.05)


def test_velocities_are_along_the_axes_of_the_scan() -> None:
    tracker = Tracker()
    for step in range(20):  # drives north in the scan whose x points south
        tracks = tracker(found((-step, 0.0, 0.9, 0)), step / 10, pose(yaw=np.pi))
    assert tracks.velocities_mps[0] == pytest.approx([-10, 0], abs=0.2)


def test_time_that_goes_back_begins_another_drive_and_pauses_end_tracks() -> None:
    tracker = Tracker()
    tracker(found((10, 0, 0.9, 0)), 5.0)
    assert tracker(found((10, 0, 0.9, 0)), 1.0).track_ids.tolist() == [1]
    assert tracker(found((10, 0, 0.9, 0)), 9.0).track_ids.tolist() == [2]
    assert tracker(found((10, 0, 0.9, 0)), 9.0).track_ids.tolist() == [2], "the same moment again"


def test_plain_values() -> None:
    tracker = Tracker()
    assert tracker(Detections.empty(NAMES), 0.0).to_dicts() == []
    (record,) = tracker(found((10, 0, 0.9, 0)), 1.0).to_dicts()
    assert record["class"] == "Car" and record["track_id"] == 0 and record["vx_mps"] == record["vy_mps"] == 0.0


@pytest.mark.parametrize(
    "values", [{"birth_score": 1.5}, {"report_score": -0.1}, {"max_unseen_s": 0}, {"birth_score": {}}]
)
def test_impossible_settings_are_refused(values: dict) -> None:
    with pytest.raises(ConfigError):
        Tracker(**values)


def test_wrong_poses_and_times_are_refused() -> None:
    for wrong in (np.eye(3), np.full((4, 4), np.nan)):
        with pytest.raises(ConfigError, match="4x4"):
            Tracker()(found(), 0.0, wrong)
    for shifted in (pose(5).T, 1000 * pose(), np.diag([1, -1, 1, 1])):
        with pytest.raises(ConfigError, match="must be a rotation and a shift in metres"):
            Tracker()(found(), 0.0, shifted)
    with pytest.raises(ConfigError, match="time nan"):
        Tracker()(found(), float("nan"))


def test_tracks_begin_at_the_thresholds_and_go_on_below_the_lowest() -> None:
    own = {one.name: one.score_threshold for one in load_bundle(find_bundle(None)).spec.classes}
    births, least = track_thresholds(None)
    assert births == own and least == pytest.approx(WEAK_SHARE * min(own.values()))
    births, least = track_thresholds(None, {"Car": 0.1})
    assert births == own | {"Car": 0.1} and least == pytest.approx(WEAK_SHARE * 0.1)
    with pytest.raises(ConfigError, match="Tram"):
        track_thresholds(None, {"Tram": 0.5})
