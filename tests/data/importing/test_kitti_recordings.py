"""Imports of KITTI's tracking benchmark and raw recordings, small ones in their published formats, made here."""

import re
from pathlib import Path

import numpy as np
import pytest

from asca_pillars.base.errors import DatasetError
from asca_pillars.data.boxes.box_split import BoxSplit
from asca_pillars.data.frames import read_frame
from asca_pillars.data.importing.imported import drop_unwritable
from asca_pillars.data.importing.kitti_raw import read_kitti_raw
from asca_pillars.data.importing.kitti_tracking import read_kitti_tracking
from asca_pillars.geometry.boxes import points_in_boxes
from tests.helpers.in_process import invoke

# The LiDAR's axes in the camera's: x right is -y, y down is -z, z ahead is x.
CALIBRATION = """P2: 700 0 600 0 0 700 180 0 0 0 1 0
R_rect 1 0 0 0 1 0 0 0 1
Tr_velo_cam 0 -1 0 0 0 0 -1 0 1 0 0 0
"""
TRACKLETS = """<?xml version="1.0" encoding="UTF-8" standalone="yes" ?>
<!DOCTYPE boost_serialization>
<boost_serialization signature="serialization::archive" version="9">
<tracklets class_id="0" tracking_level="0" version="0">
<count>1</count><item_version>1</item_version>
<item class_id="1" tracking_level="0" version="1">
<objectType>Van</objectType><h>2</h><w>1.8</w><l>4.5</l><first_frame>1</first_frame>
<poses class_id="2" tracking_level="0" version="0"><count>2</count><item_version>2</item_version>
<item class_id="3" tracking_level="0" version="2">
<tx>12</tx><ty>3</ty><tz>-1.7</tz><rx>0</rx><ry>0</ry><rz>0.4</rz></item>
<item><tx>13</tx><ty>3</ty><tz>-1.7</tz><rx>0</rx><ry>0</ry><rz>0.4</rz></item>
</poses><finished>1</finished></item></tracklets></boost_serialization>
"""


def write_scan(path: Path) -> None:
    """Points in a box at 12 m and as many right behind the sensor."""
    path.parent.mkdir(parents=True, exist_ok=True)
    near = np.random.default_rng(0).uniform(-0.5, 0.5, (40, 3))
    points = np.concatenate([near + np.array([12, 3, -0.7]), near + np.array([-12, 0, -0.7])])
    np.column_stack([points, np.full(80, 0.3)]).astype("<f4").tofile(path)


def write_tracking(root: Path) -> Path:
    training = root / "training"
    for sequence in ("0000", "0001"):
        for number in range(2):
            write_scan(training / "velodyne" / sequence / f"{number:06d}.bin")
        # KITTI gives the middle of the bottom in the camera's frame: x -3, y 1.7, z 12, facing the camera's x.
        lines = [
            "1 7 Van 0 0 0.1 500 100 600 200 2 1.8 4.5 -3 1.7 12 -1.5707963",
            "1 -1 DontCare -1 -1 -10 1 1 9 9 -1 -1 -1 -1000 -1000 -1000 -10",
        ]
        for folder, text in (("label_02", "\n".join(lines)), ("calib", CALIBRATION)):
            (training / folder).mkdir(exist_ok=True)
            (training / folder / f"{sequence}.txt").write_text(text)
    return root


def test_tracking(tmp_path: Path) -> None:
    """Nothing is labelled behind the car, so that nothing there may be taken for background."""
    source, out = write_tracking(tmp_path / "kitti"), tmp_path / "out"
    assert "boxes: Van 2" in invoke("import", source, out, "--from", "kitti-tracking")
    split = BoxSplit(out, "train")
    assert split.frame_ids == ("0000/000000", "0000/000001")
    assert len(split.labeled_boxes("0000/000000").boxes) == 0
    boxes, types = split.labeled_boxes("0000/000001")
    assert types == ("Van",) and split.records("0000/000001").track_ids == ("7",)
    assert boxes[0].tolist() == pytest.approx([12, 3, -0.7, 4.5, 1.8, 2, 0], abs=1e-4)
    assert split.has_camera and len(split.points("0000/000001")) == 80
    assert len(split.points("0000/000001", camera_view=True)) == 40
    assert len(read_frame(split, "0000/000001", ("Van",)).points) == 40


def write_drive(root: Path, tracklets: str) -> Path:
    for number in range(3):
        write_scan(root / "drive" / "velodyne_points" / "data" / f"{number:010d}.bin")
    (root / "drive" / "tracklet_labels.xml").write_text(tracklets)
    return root


def test_raw(tmp_path: Path) -> None:
    source = write_drive(tmp_path, TRACKLETS)
    imported = read_kitti_raw(source)
    assert [len(frame.records.types) for frame in imported.frames] == [0, 1, 1]
    records = imported.frames[1].records
    assert records.boxes[0].tolist() == pytest.approx([12, 3, -0.7, 4.5, 1.8, 2, 0.4])
    assert records.types == ("Van",) and records.track_ids == ("0",)
    points = np.fromfile(imported.frames[1].scan, "<f4").reshape(-1, 4)
    assert points_in_boxes(points, records.boxes).sum() == 40
    invoke("import", source, tmp_path / "out", "--from", "kitti-raw", "--val-share", 0.3)
    assert BoxSplit(tmp_path / "out", "train").settings.labeled_view_deg == 81


def test_sitting_persons_have_the_name_that_training_and_scores_know(tmp_path: Path) -> None:
    """The two recordings spell them in other ways than the object benchmark does."""
    tracking = write_tracking(tmp_path / "tracking")
    for path in (tracking / "training" / "label_02").iterdir():
        path.write_text(path.read_text().replace("Van", "Person"))
    raw = write_drive(tmp_path / "raw", TRACKLETS.replace("Van", "Person (sitting)"))
    for imported in (read_kitti_tracking(tracking), read_kitti_raw(raw)):
        assert {kind for frame in imported.frames for kind in frame.records.types} == {"Person_sitting"}


DOCTYPE = "<!DOCTYPE boost_serialization>"
ATTRIBUTES = "<!DOCTYPE boost_serialization [<!ATTLIST item x CDATA 'y'>]>"


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("</tracklets>", "", "mismatched tag"),
        (DOCTYPE, "<!DOCTYPE b [<!ENTITY a 'b'>]>", "another DOCTYPE than"),
        (DOCTYPE, ATTRIBUTES, "another DOCTYPE than"),
        (DOCTYPE, DOCTYPE + ATTRIBUTES, "another DOCTYPE than"),
    ],
)
def test_files_that_are_no_tracklets_are_refused(tmp_path: Path, old: str, new: str, message: str) -> None:
    (tmp_path / "tracklet_labels.xml").write_text(TRACKLETS.replace(old, new))
    with pytest.raises(DatasetError, match=f"tracklet_labels.xml: not a KITTI tracklet file .*{message}"):
        read_kitti_raw(tmp_path)


@pytest.mark.parametrize(
    ("old", "new", "message", "left"),
    [
        ("<h>2</h>", "<h>-2</h>", r"tracklets: 1, .*tracklet 0: no size \(-2, 1\.8, 4\.5\)", 0),
        ("<h>2</h>", "<h>0.00001</h>", "boxes: 2, .*no box of a Van", 0),
        ("<tx>12</tx>", "<tx>nan</tx>", "boxes: 1, .*tracklet 0, pose 0: .*not 4 finite numbers", 1),
        ("<rz>0.4</rz>", "<rz>90</rz>", "boxes: 1, .*no box of a Van", 1),
        ("<l>4.5</l>", "", "tracklets: 1, .*could not convert", 0),
        ("<objectType>Van</objectType>", "", "tracklets: 1, .*objectType is '', not a name", 0),
        ("<first_frame>1", "<first_frame>x", "tracklets: 1, .*invalid literal", 0),
    ],
)
def test_one_bad_tracklet_costs_itself(tmp_path: Path, old: str, new: str, message: str, left: int) -> None:
    assert old in TRACKLETS
    imported = read_kitti_raw(write_drive(tmp_path, TRACKLETS.replace(old, new, 1)))
    if left:
        imported = drop_unwritable(imported)
        assert re.search(message, " ".join(imported.skipped.lines()))
        assert [kind for frame in imported.frames for kind in frame.records.types] == ["Van"] * left
    else:
        with pytest.raises(DatasetError, match=message):
            drop_unwritable(imported)


def test_mistakes_are_named(tmp_path: Path) -> None:
    with pytest.raises(DatasetError, match=r"no tracklet_labels\.xml below"):
        read_kitti_raw(tmp_path)
    with pytest.raises(DatasetError, match=r"no label_02/\*\.txt there"):
        read_kitti_tracking(tmp_path)
    labels = write_tracking(tmp_path) / "training" / "label_02" / "0000.txt"
    good = labels.read_text()
    labels.write_text(f"Car 0 0 0\n1 2 Car 0 0 0\n{good}")
    imported = drop_unwritable(read_kitti_tracking(tmp_path))
    (line,) = imported.skipped.lines()
    assert re.search(r"lines: 2, the first: .*0000\.txt:1: does not begin with a frame's number", line)
    assert sum(len(frame.records.types) for frame in imported.frames) == 2
    for path in labels.parent.iterdir():
        path.write_text("Car 0 0 0")
    with pytest.raises(DatasetError, match=r"no box there that can be used; .*0000\.txt:1: does not begin"):
        drop_unwritable(read_kitti_tracking(tmp_path))
