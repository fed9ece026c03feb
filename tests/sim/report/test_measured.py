"""Statistics of a made-up folder, known from how it was made."""

from pathlib import Path

import numpy as np
import pytest

from asca_pillars.base.errors import DatasetError, ScanError
from asca_pillars.sim.report.comparison import Measured, measure
from asca_pillars.sim.report.scan_statistics import fit_cars, ring_counts
from tests.sim.report.made_up import CAR_LAW, COLUMNS, GROUND_Z_M, SENSOR, rings, write_set


@pytest.fixture(scope="module")
def measured(tmp_path_factory: pytest.TempPathFactory) -> Measured:
    return measure(write_set(tmp_path_factory.mktemp("whole")))


def test_scans_and_labels(measured: Measured) -> None:
    scan = measured.statistics.scan
    truth = rings(np.random.default_rng(0))[1]
    assert scan.scans == 6 and scan.points is not None and scan.ground_share is not None
    assert scan.points.mean == pytest.approx(64 * COLUMNS, rel=0.02)
    assert scan.ground_share.mean == pytest.approx(truth.mean(), abs=0.02)
    assert scan.points_per_ring is not None and scan.points_per_ring[1:] == (COLUMNS,) * 63
    assert scan.points_per_ring[0] > COLUMNS, "the objects belong to the first ring"
    assert scan.range_points is not None and sum(scan.range_points) == pytest.approx(scan.points.mean)
    assert scan.sector_points is not None and scan.sector_points[36] == 64 * COLUMNS / 72
    assert scan.ground_z_m is not None and scan.ground_z_m[0] is not None
    assert scan.ground_z_m[0].mean == pytest.approx(GROUND_Z_M, abs=0.01)
    assert scan.ground_z_m[5] is None, "nothing is so far"
    labels = measured.statistics.labels
    assert set(labels) == {"Car", "Pedestrian"} and measured.statistics.dont_care_per_frame == 1
    car, person = labels["Car"], labels["Pedestrian"]
    assert car.per_frame[:3] == (0, 6, 0) and person.per_frame[:3] == (0, 3, 3)
    assert car.length_m.mean == pytest.approx(4.25, abs=0.01) and car.length_m.percentiles[2] == pytest.approx(4.25)
    assert car.range_counts[2:8] == (1, 1, 1, 1, 1, 1)
    assert (car.yaw_same, car.yaw_oncoming, person.yaw_across, person.yaw_oncoming) == (1, 0, 6 / 9, 3 / 9)
    assert car.occlusion == (6, 0, 0, 0) and person.occlusion == (0, 6, 3, 0)
    assert car.bottom_z_m[1] is not None and car.bottom_z_m[1].mean == pytest.approx(-1.65, abs=0.006)


def test_reflectance_of_ground_and_objects_and_the_law_of_points(measured: Measured) -> None:
    reflectance = measured.statistics.scan.reflectance
    assert set(reflectance) == {"overall", "ground", "non_ground", "car", "pedestrian"}
    ground = np.array(reflectance["ground"].counts)
    assert ground[[0, 20, 30]].sum() / ground.sum() > 0.98
    np.testing.assert_allclose(ground[[0, 20, 30]] / ground.sum(), 1 / 3, atol=0.02)
    parts = np.array([reflectance[name].counts for name in ("overall", "ground", "non_ground")])
    np.testing.assert_array_equal(parts[0], parts[1] + parts[2])
    assert np.flatnonzero(reflectance["car"].counts).tolist() == [0, 10, 60]
    assert (reflectance["car"].units, reflectance["pedestrian"].units) == (6, 9)
    fit = measured.statistics.scan.car_fit
    assert fit is not None and fit.cars == 6
    near = measured.statistics.scan.near_car_fit
    assert near is not None and near.b == pytest.approx(fit.b, abs=0.02)
    for range_m in (10, 20, 30, 40):
        assert fit.points_at(range_m) == pytest.approx(np.exp(CAR_LAW[0]) * range_m ** CAR_LAW[1], rel=0.02)
    assert fit.error_at(20) < fit.error_at(10) < 0.02


def test_a_camera_view_gives_what_it_can(measured: Measured, tmp_path: Path) -> None:
    view = measure(write_set(tmp_path, camera_view=True)).statistics
    assert view.labels == measured.statistics.labels
    assert view.scan.car_fit == measured.statistics.scan.car_fit
    assert view.scan.camera_points == measured.statistics.scan.camera_points
    assert view.scan.points is view.scan.ground_share is view.scan.points_per_ring is view.scan.range_points is None
    assert set(view.scan.reflectance) == {"car", "pedestrian"}


def test_rings_in_any_order_and_fits_of_cars_that_stand_apart() -> None:
    rng = np.random.default_rng(0)
    points, _ = rings(rng)
    assert ring_counts(points, SENSOR).tolist() == [COLUMNS] * 64
    assert ring_counts(rng.permutation(points), SENSOR).tolist() == [COLUMNS] * 64
    np.testing.assert_array_equal(ring_counts(points[: 32 * COLUMNS], SENSOR), [COLUMNS] * 32)
    apart = np.array([[15, 500], [20, 300], [30, 80], [40, 30], [50, 20.0]])
    span_m = (12.0, 60.0)
    assert fit_cars(apart, span_m) is not None
    assert fit_cars(apart[:4], span_m) is None
    assert fit_cars(np.column_stack([np.full(9, 20.0), np.full(9, 300.0)]), span_m) is None
    others = np.array([[5, 9999], [25, 0], [79, 1.0]])
    assert fit_cars(np.concatenate([apart, others]), span_m) == fit_cars(apart, span_m), "out of the span, or empty"


def test_only_so_many_scans_are_read_and_bad_folders_are_refused(tmp_path: Path) -> None:
    root = write_set(tmp_path)
    some = measure(root, max_scans=2)
    assert some.statistics.scan.scans == 2 and some.statistics.frames == 6
    assert [round(float(record.cars[0, 0]), 1) for record in some.records] == [12.5, 37.5]
    with pytest.raises(DatasetError, match=r"no \*\.bin scans there"):
        measure(tmp_path / "none")
    root = write_set(tmp_path / "set", 2)
    (root / "training/velodyne/000001.bin").write_bytes(b"12345")
    with pytest.raises(ScanError, match=r"000001\.bin: file size \(5 bytes"):
        measure(root)
    (root / "training/label_2/000001.txt").unlink()
    with pytest.raises(DatasetError, match=r"000001\.txt: cannot read the labels"):
        measure(root)
    (root / "training/label_2/000000.txt").unlink()
    with pytest.raises(DatasetError, match="label_2: no labels there"):
        measure(root)
