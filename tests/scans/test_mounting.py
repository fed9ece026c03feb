"""A sensor that is mounted otherwise: heights, axes, poses, and what is refused."""

from itertools import permutations, product
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from asca_pillars.base.errors import ConfigError
from asca_pillars.base.schema import parse, to_dict
from asca_pillars.scans.mounting import Mounting, read_pose

POINT = np.array([[3.0, 5.0, -1.0, 0.4]], np.float32)
UPRIGHT = [
    ",".join((*(s + n for s, n in zip(signs, names, strict=False)), signs[2] + "z"))
    for names in permutations("xy")
    for signs in product(["", "-"], repeat=3)
]


@pytest.mark.parametrize(
    ("axes", "expected"),
    [
        ("x-forward", [3, 5, -1]),
        ("y-forward", [5, -3, -1]),
        ("-y,x,z", [-5, 3, -1]),
        ("x,-y,-z", [3, -5, 1]),
        ("+x, -y, z", [3, -5, -1]),
    ],
)
def test_axes_say_where_forward_left_and_up_are_found(axes: str, expected: list[float]) -> None:
    changed = Mounting(axes=axes).to_model(1.7).points(POINT)
    np.testing.assert_array_equal(changed, [[*expected, POINT[0, 3]]])


@pytest.mark.parametrize("axes", UPRIGHT)
def test_all_axes_with_z_up_or_down_go_there_and_back(axes: str) -> None:
    change = Mounting(sensor_height_m=0.5, axes=axes).to_model(1.75)
    points = np.random.default_rng(2).uniform(-50, 50, (30, 4)).astype(np.float32)
    np.testing.assert_allclose(change.inverse.points(change.points(points)), points, atol=1e-5)


@given(st.floats(-5, 5), st.floats(0.5, 3))
def test_the_ground_comes_where_the_model_expects_it(height: float, trained: float) -> None:
    ground = np.array([[7.0, 1.0, -height, 0.1]])
    assert Mounting(sensor_height_m=height).to_model(trained).points(ground)[0, 2] == pytest.approx(-trained, abs=1e-5)


def test_poses_lift_and_turn_and_without_a_height_nothing_is_lifted() -> None:
    assert Mounting().to_model(1.7).is_identity
    assert Mounting(sensor_height_m=1.2).to_model(None).is_identity  # nobody knows how high the model's was
    pose = ((0.0, 1.0, 0.0, 2.0), (-1.0, 0.0, 0.0, 0.0), (0.0, 0.0, 1.0, 1.84), (0.0, 0.0, 0.0, 1.0))
    mounting = Mounting(sensor_height_m=0.0, pose=np.array(pose))  # type: ignore[arg-type]  # what NumPy's users have
    np.testing.assert_allclose(mounting.level.points(POINT)[0, :3], [5 + 2, -3, -1 + 1.84], atol=1e-6)
    np.testing.assert_allclose(mounting.to_model(1.73).points(POINT)[0, :3], [5 + 2, -3, -1 + 1.84 - 1.73], atol=1e-6)
    assert mounting == Mounting(sensor_height_m=0.0, pose=pose) and hash(mounting)


def rows(*diagonal: float) -> tuple[tuple[float, ...], ...]:
    return tuple(map(tuple, np.diag(diagonal).tolist()))


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"axes": "x,y"}, "axes x,y: give"),
        ({"axes": "x,x,z"}, "give x-forward"),
        ({"axes": "--x,y,z"}, "give x-forward"),
        ({"axes": "z,-x,-y"}, "z axis, which must point up or down"),
        ({"axes": None}, "axes None: give"),
        ({"sensor_height_m": float("nan")}, "sensor height nan"),
        ({"sensor_height_m": 40.0}, "at most 10"),
        ({"sensor_height_m": "auto"}, r"sensor height 'auto': give metres; .measured_mounting"),
        ({"pose": "pose.txt"}, r"pose 'pose.txt': give a 4x4 matrix; .read_pose"),
        ({"pose": np.eye(3)}, r"pose of shape \(3, 3\): give a 4x4 matrix"),
        ({"pose": np.eye(4).ravel()}, r"pose of shape \(16,\)"),
        ({"pose": rows(1, 1, 2, 1)}, "a rotation and a shift"),
        ({"pose": rows(1, -1, 1, 1)}, "a rotation and a shift"),
        ({"pose": rows(1, 1, 1, 1), "axes": "y-forward"}, "give one of them"),
    ],
)
def test_what_cannot_be_is_refused(settings: dict, message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        Mounting(**settings)


def test_pose_files_and_configs_and_back(tmp_path: Path) -> None:
    mounting = parse(Mounting, {"sensor_height_m": 1.2, "axes": "y-forward"}, "here")
    assert parse(Mounting, to_dict(mounting), "there") == mounting
    with pytest.raises(ConfigError, match="did you mean `axes`"):
        parse(Mounting, {"axis": "y-forward"}, "here")
    path = tmp_path / "pose.txt"
    np.savetxt(path, np.eye(4))
    assert Mounting(pose=read_pose(path)).level.is_identity
    scaled = [" ".join(map(str, np.diag([scale] * 3 + [1]).ravel())) for scale in (2, 1e200, np.inf, np.nan)]
    rotation = r"pose\.txt: must be a rotation and a shift, without a scale"
    for text, message in (("1 0 0", "holds 3 numbers"), ("one", "16 numbers"), *((text, rotation) for text in scaled)):
        path.write_text(text)
        with pytest.raises(ConfigError, match=message):
            read_pose(path)
    with pytest.raises(ConfigError, match=r"none\.txt"):
        read_pose(tmp_path / "none.txt")
