"""Text files as the programs of sensors export them."""

import numpy as np
import pytest

from asca_pillars.base.errors import ScanError
from tests.scans.scan_files import read

LIVOX = (
    "Version,Slot ID,LiDAR Index,Rsvd,Error Code,Timestamp Type,Data Type,Timestamp,X,Y,Z,Reflectivity,Tag,Ori_x\n"
    "5,1,1,0,0x00000000,0,0,2444124311890,4.971,-0.365,0.411,51,0,4971\n"
)
VELOVIEW = (
    '"Points_m_XYZ:0","Points_m_XYZ:1","Points_m_XYZ:2","X","Y","Z","intensity","laser_id"\n'
    "9,9,9,4.971,-0.365,0.411,51,7\n"
)
OLD_VELOVIEW = '"intensity","Points:0","Points:1","Points:2"\n51,4.971,-0.365,0.411\n'
OUSTER = (
    "# TIMESTAMP (ns), ROW, DESTAGGERED IMAGE COLUMN, RANGE (mm), REFLECTIVITY (%), X1 (m), Y1 (m), Z1 (m), X2 (m)\n"
    "11, 0, 512, 5000, 51, 4.971, -0.365, 0.411, 0.000\n"
)
CLOUDCOMPARE = "//X Y Z R G B Intensity\n4.971 -0.365 0.411 200 200 200 51.000000\n"
TIMES = "\ufefftime;x;y;z;i\n2024-05-01 10:00:00;4.971;-0.365;0.411;51\n"


@pytest.mark.parametrize("content", [LIVOX, VELOVIEW, OLD_VELOVIEW, OUSTER, CLOUDCOMPARE, TIMES])
def test_columns_are_found_by_the_names_that_programs_give_them(tmp_path, content):
    scan = read(tmp_path, "a.csv", content.encode())
    np.testing.assert_allclose(scan.points, [[4.971, -0.365, 0.411, 0.2]], rtol=1e-6)


@pytest.mark.parametrize(
    ("content", "points", "remarks"),
    [
        ("1 2 3\n\n4 5 6\n", [[1, 2, 3, 0], [4, 5, 6, 0]], 0),
        ("1,2,3,0.5,7,7\n", [[1, 2, 3, 0.5]], 1),
        ("# made on a Monday\n1 2 3 0.5\n", [[1, 2, 3, 0.5]], 0),
        ("1 2 3 0.5\nnan 2 3 0.5\n", [[1, 2, 3, 0.5]], 0),
        ("x,y,z\n", np.zeros((0, 4)), 0),
    ],
)
def test_without_names_the_first_columns_are_x_y_z_and_the_reflectance(tmp_path, content, points, remarks):
    scan = read(tmp_path, "a.txt", content.encode())
    np.testing.assert_array_equal(scan.points, points)
    assert len(scan.notes.remarks) == remarks


@pytest.mark.parametrize(
    ("content", "words"),
    [
        ("x,y\n1,2\n", "does not name x, y and z"),
        ("scan,boxes\na,b\n", "no names x, y and z and no line that begins with a number"),
        ("1 2\n", "no field z"),
        ("x,y,z,x\n1,2,3,4\n", "2 fields x"),
        ("x,y,z\n1,2,3,4\n", "3 names above points of 4 values"),
        ("1,2,3\n4,5\n", "point 1 has 2 values and the first has 3"),
        ("1 2 3\n4 5 6 7\n", "point 1 has 4 values and the first has 3"),
        ("x,y,z\n1,,3\n", "could not convert"),
        ("1,5;2;3\n", "write them with points"),
    ],
)
def test_what_is_no_table_of_points_is_refused(tmp_path, content, words):
    with pytest.raises(ScanError, match=words):
        read(tmp_path, "a.csv", content.encode())
