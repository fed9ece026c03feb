"""Times of the scans of a folder: by a rate, or from a file."""

from pathlib import Path

import pytest

from asca_deploy.detect_scans import require_one_folder, scan_times_ns
from asca_pillars.base.errors import ConfigError, ScanError


def test_times_by_a_rate_begin_at_0_and_those_of_a_file_are_its_seconds(tmp_path: Path) -> None:
    assert scan_times_ns(3) == [0, 100_000_000, 200_000_000]
    assert scan_times_ns(3, 20.0) == [0, 50_000_000, 100_000_000]
    for rate_hz in (0.0, -1.0, float("nan"), 1e4):
        with pytest.raises(ConfigError, match=r"--rate .*: give scans per second"):
            scan_times_ns(3, rate_hz)
    path = tmp_path / "times.txt"
    path.write_text("0\n1.036e-01\n\n1700000000.25\n")  # as KITTI's odometry writes them, and a clock's
    assert scan_times_ns(3, times=path) == [0, 103_600_000, 1_700_000_000_250_000_000]
    with pytest.raises(ConfigError, match=r"--rate 10 and --times .*: give one of them"):
        scan_times_ns(3, 10.0, path)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("0\n0.1\n", r"times\.txt: 2 times for 3 scans"),
        ("0\n0.2\n0.1\n", r"times\.txt:3: 0\.1 is not after"),
        ("0\n0.1\n0.1\n", r"times\.txt:3: 0\.1 is not after"),
        ("0\nnan\n0.1\n", r"times\.txt:2: 'nan' is not a time"),
        ("0\n1e30\n2e30\n", r"times\.txt:2: '1e30' is not a time"),
        ("time\n0\n0.1\n", r"times\.txt:1: 'time' is not a time"),
    ],
)
def test_files_that_list_no_times_are_refused(tmp_path: Path, text: str, message: str) -> None:
    (tmp_path / "times.txt").write_text(text)
    with pytest.raises(ScanError, match=message):
        scan_times_ns(3, times=tmp_path / "times.txt")


def test_what_is_no_text_and_scans_of_several_folders_are_refused(tmp_path: Path) -> None:
    (tmp_path / "times.txt").write_bytes(b"\xff\xfe0")
    for path, message in ((tmp_path / "times.txt", "is not text"), (tmp_path / "none.txt", "none.txt: ")):
        with pytest.raises(ScanError, match=message):
            scan_times_ns(3, times=path)
    require_one_folder([Path("a/1.bin"), Path("a/2.bin")])
    with pytest.raises(ConfigError, match="a and b: "):
        require_one_folder([Path("a/1.bin"), Path("b/1.bin")])
