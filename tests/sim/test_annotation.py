"""Labels follow what KITTI's annotators could see."""

from collections.abc import Callable
from types import SimpleNamespace

import numpy as np
import pytest

from asca_pillars.data.kitti import KittiObject
from asca_pillars.sim.annotation import label_all_around, label_camera_view
from asca_pillars.sim.scene_config import SceneConfig
from asca_pillars.sim.world.placement import Target
from asca_pillars.sim.world.scene import draw_calibration


def labels_of(
    x_m: float,
    y_m: float,
    alone: int,
    visible: int,
    points: int,
    label: Callable[..., list[KittiObject]] = label_camera_view,
) -> list[KittiObject]:
    """Labels of one car of which `visible` of `alone` firings and `points` returns tell."""
    box = np.array([x_m, y_m, -0.9, 4.0, 1.6, 1.5, 0.0])
    hits = SimpleNamespace(alone=np.array([alone]), visible=np.array([visible]))
    calibration = draw_calibration(np.random.default_rng(0))
    return label((Target("Car", box),), hits, np.zeros(points, np.int32), calibration, SceneConfig())


@pytest.mark.parametrize(("visible", "state"), [(95, 0), (83, 0), (82, 1), (70, 1), (36, 2), (20, 2), (9, 3), (7, 3)])
def test_the_share_of_visible_rays_is_the_occlusion_state(visible: int, state: int) -> None:
    (label,) = labels_of(20.0, 0.0, 100, visible, 50)
    assert (label.type, label.occluded, label.truncated) == ("Car", state, 0.0)


def test_what_is_hardly_visible_is_dont_care_and_what_is_hidden_has_no_label() -> None:
    assert [o.type for o in labels_of(20.0, 0.0, 100, 2, 50)] == ["DontCare"]
    assert [o.type for o in labels_of(90.0, 0.0, 40, 40, 0)] == ["DontCare"]
    assert [o.type for o in labels_of(60.0, 0.0, 40, 40, 2)] == ["Car"]
    assert labels_of(20.0, 0.0, 100, 0, 0) == []
    assert labels_of(-20.0, 0.0, 100, 100, 50) == []


def test_a_car_at_the_border_is_truncated_and_unknown_when_hardly_in_it() -> None:
    states = {}
    for y in np.arange(2.0, 9.0, 0.1):
        for label in labels_of(5.0, float(y), 100, 100, 50):
            states[label.truncated] = label.occluded
    assert any(0.2 < cut <= 0.85 for cut in states)
    assert all(state == (3 if cut > 0.85 else 0) for cut, state in states.items() if cut != 0.85)
    assert 3 in states.values()


def test_all_around_whatever_returns_a_point_is_labelled() -> None:
    for x, y in ((20.0, 0.0), (-20.0, 3.0), (2.0, -15.0), (0.5, 9.0)):
        (label,) = labels_of(x, y, 100, 70, 50, label_all_around)
        assert (label.type, label.occluded) == ("Car", 1)
        assert label.bbox == (-1, -1, -1, -1) if x < 5 else label.bbox[2] > label.bbox[0]
        assert label.truncated == (-1 if x < 5 else 0)
    assert labels_of(-20.0, 3.0, 100, 0, 0, label_all_around) == []
    (one_point,) = labels_of(-60.0, 0.0, 40, 40, 1, label_all_around)
    (hidden,) = labels_of(-20.0, 0.0, 100, 3, 3, label_all_around)
    assert [(o.type, o.occluded) for o in (one_point, hidden)] == [("Car", 3)] * 2
    cut = [labels_of(5.0, y, 100, 100, 50, label_all_around)[0].truncated for y in (2.0, 4.0, 5.0)]
    assert 0 <= cut[0] < cut[1] < cut[2] <= 1
