"""Scans without labels: what is measured, that the warnings are the detector's, and what is refused."""

import gzip
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("rosbags", reason="needs pip install -e '.[recordings]'")

from asca_deploy import Detector, sample_scan_path
from asca_deploy.inspect_scans import inspect_scans
from asca_pillars.base.errors import AscaError, ScanError
from asca_pillars.scans.mounting import Mounting
from asca_pillars.scans.scan_reader import read_scan, write_scan
from asca_pillars.scans.scan_settings import ScanSettings
from tests.helpers.in_process import invoke, run_here
from tests.helpers.scenes import write_dataset
from tests.scans.recordings.cloud_recordings import clouds, laid_out, stamps, write_mcap

POINTS = read_scan(sample_scan_path()).points[::4].copy()
TURNED = np.column_stack([-POINTS[:, 1], POINTS[:, 0], POINTS[:, 2], POINTS[:, 3]])
"""x to the right, y forward."""


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    for number, points in enumerate((POINTS, TURNED, POINTS[:5])):
        np.save(tmp_path / f"{number}.npy", points)
    return tmp_path


@pytest.mark.parametrize("around", [False, True])
@pytest.mark.parametrize("axes", ["x-forward", "y-forward"])
def test_the_warnings_are_those_of_the_detector(folder: Path, axes: str, around: bool) -> None:
    reading = ScanSettings(sensor_height=0.5, axes=axes)
    detector = Detector(mounting=Mounting(0.5, axes), view="around" if around else "ahead")
    for number, points in enumerate((POINTS, TURNED, POINTS[:5])):
        warnings = detector(points).report.warnings
        assert warnings
        found = inspect_scans(folder / f"{number}.npy", reading=reading, around=around)
        assert [line for line in found.findings if line.startswith(f"{number}.npy: ")] == [
            f"{number}.npy: {text}" for text in warnings
        ]


def test_files_are_measured(folder: Path) -> None:
    found = inspect_scans(folder)
    assert (found.scans, found.inspected, found.topic, found.times, found.problems) == (3, 3, None, None, ())
    assert found.points is not None and (found.points.median, found.points.largest) == (len(POINTS), len(POINTS))
    assert found.reflectance_scales == (1.0,) and found.not_finite == 0
    alone = inspect_scans(folder / "0.npy")
    counts = Detector()(POINTS).report.counts
    assert alone.inside_share is not None
    assert alone.inside_share.median == pytest.approx(1 - counts.points_outside / counts.points, abs=1e-4)
    around = inspect_scans(folder / "0.npy", around=True)
    assert around.inside_share is not None and around.inside_share.median > 1.8 * alone.inside_share.median
    assert around.ranges.x_m == (-69.12, 69.12)
    assert alone.height is not None and alone.height.height_m == pytest.approx(1.73, abs=0.1)
    assert alone.ground_z_m is not None and -2 < alone.ground_z_m.median < -1.6
    stated = inspect_scans(folder / "0.npy", reading=ScanSettings(sensor_height=0.0))
    assert stated.ground_z_m is not None and stated.ground_z_m.median < -3.5, "in the model's frame"


def test_some_of_many_files_are_read(tmp_path: Path) -> None:
    for number in range(10):
        np.save(tmp_path / f"{number}.npy", POINTS[::10])
    (tmp_path / "1.npy").write_bytes(b"never read")
    steps: list[tuple[int, int]] = []
    found = inspect_scans(tmp_path, frames=3, progress=lambda _, done, total: steps.append((done, total)))
    assert (found.scans, found.inspected, found.problems) == (10, 3, ()) and steps[-1] == (3, 3)
    found = inspect_scans(tmp_path)
    assert found.inspected == 9 and found.problems[0].startswith("1 scan cannot be read: ")


def test_points_that_say_nothing(tmp_path: Path) -> None:
    broken = POINTS.copy()
    broken[:100, 2] = np.nan
    np.save(tmp_path / "1.npy", broken)
    np.save(tmp_path / "2.npy", POINTS[:0])
    found = inspect_scans(tmp_path)
    assert found.not_finite == 100 and "1.npy: 100 points are not finite and were dropped" in found.findings
    assert found.points is not None and found.points.largest == len(POINTS) - 100
    empty = inspect_scans(tmp_path / "2.npy")
    assert empty.reflectance is None and empty.inside_share is None and empty.height is None
    assert any("height cannot be estimated without a scan" in line for line in empty.findings)
    assert "  -" in invoke("inspect", tmp_path / "2.npy")
    with pytest.raises(ScanError, match="cannot be estimated"):
        inspect_scans(tmp_path / "2.npy", reading=ScanSettings(sensor_height="auto"))
    (tmp_path / "3.npy").write_bytes(b"torn")
    with pytest.raises(ScanError, match=r"none of the 1 scans can be read: .*3\.npy"):
        inspect_scans(tmp_path / "3.npy")


def test_what_is_printed_and_written(folder: Path) -> None:
    report = folder / "report.json"
    for _ in range(2):  # its own file is replaced
        output = invoke("inspect", folder, "--json", report, "-n", 2)
    assert "2 of 3 scans measured" in output and "--around" in output
    written = json.loads(report.read_text())
    assert written["inspected"] == 2 and written["findings"] and written["expected"]["camera_view"] is False
    assert written["height"]["scans"] == 2 and written["model"] == "default"
    write_scan(folder / "own" / "1.bin", POINTS[POINTS[:, 0] > 0])
    output = invoke("inspect", folder / "own" / "1.bin", "--bundle", "fast")
    assert "against fast" in output and output.endswith("Nothing to warn of.\n")


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ("{kitti}", "kitti: is a dataset; give --config"),
        *(
            (f"{{kitti}} -c asca_small_sim {option}", f"{option.split()[0]}: is for scans without labels")
            for option in ("--axes y-forward", "--topic /lidar", "--around", "--columns 5")
        ),
        *(
            (f"{{scans}} {option}", f"{option}: is for a dataset with labels; give --config")
            for option in ("--set train.epochs=2", "--split val", "--propose own.yaml", "--draw 2", "--out pictures")
        ),
        ("{scans}/0.npy --topic /lidar", "--topic /lidar: is for recordings"),
        ("{odd}", "several topics hold scans, give --topic: /lidar"),
        ("{odd} --topic /imu", "/imu holds sensor_msgs/msg/Imu, not scans"),
        ("{odd} --topic /lidar --columns 5", "--columns 5: is for .bin files"),
        ("{odd} --config asca_small_sim", "is a recording, and --config asca_small_sim for datasets"),
        ("{odd} --topic /lidar --bundle nowhere", "nowhere"),
    ],
)
def test_what_does_not_go_together_is_one_line(folder: Path, odd: Path, options: str, message: str) -> None:
    kitti = write_dataset(folder / "kitti", 1)
    with pytest.raises(AscaError) as error:
        invoke("inspect", *options.format(kitti=kitti, scans=folder, odd=odd).split())
    assert message in str(error.value) and "\n" not in str(error.value)


@pytest.fixture
def odd(tmp_path: Path) -> Path:
    """Nine scans at 10 Hz, of which the fifth and sixth are missing, and a message that cannot be read."""
    times = [stamps(9)[number] for number in (0, 1, 2, 3, 6, 7, 8)]
    bytewise = POINTS * np.array([1, 1, 1, 255], np.float32)
    messages = [(time_ns, laid_out(bytewise, time_ns=time_ns)) for time_ns in times]
    messages.insert(2, (times[1] + 50, b"torn"))
    others = {"/imu": "sensor_msgs/msg/Imu"}
    return write_mcap(tmp_path / "odd.mcap", {"/lidar": messages, "/rear": clouds(2)}, others=others)


def test_a_recording_is_described(odd: Path) -> None:
    found = inspect_scans(odd, topic="/lidar", reading=ScanSettings(sensor_height="auto"))
    assert (found.scans, found.inspected) == (8, 7) and found.frame_ids == ("lidar",)
    assert found.fields == ("x", "y", "z", "intensity") and found.reflectance_scales == (255.0,)
    assert [topic.name for topic in found.topics] == ["/imu", "/lidar", "/rear"]
    times = found.times
    assert times is not None and times.rate_hz == pytest.approx(10) and times.seconds == pytest.approx(0.8)
    assert (times.gaps, times.missing, times.longest_gap_after) == (1, 2, 4)
    assert times.longest_gap_s == pytest.approx(0.3)
    assert any(
        line.startswith("1 gap in the time stamps, the longest of 0.3 s after scan 4: ") for line in found.findings
    )
    assert any("reflectances were taken as 0..255" in line for line in found.findings)
    assert found.problems and found.problems[0].startswith("1 scan cannot be read: ")
    assert "/lidar, message 2" in found.problems[0]
    assert inspect_scans(odd, topic="/lidar", frames=4).inspected == 3, "of 0, 2, 4 and 6 all but the torn one"


def test_a_recording_in_the_terminal(odd: Path) -> None:
    done = run_here("inspect", odd, "--topic", "/lidar", "--json", odd.parent / "report.json")
    assert done.returncode == 3 and "message 2" in done.stderr and "sensor_msgs/msg/Imu" in done.stdout
    assert "0.8 s, 10 scans per second; frame lidar; fields x, y, z, intensity" in done.stdout
    report = json.loads((odd.parent / "report.json").read_text())
    assert report["times"]["missing"] == 2 and report["topics"][0]["type"] == "sensor_msgs/msg/Imu"


def test_a_packed_recording_says_so(odd: Path) -> None:
    packed = odd.with_suffix(".mcap.gz")
    packed.write_bytes(gzip.compress(odd.read_bytes()))
    output = invoke("inspect", packed, "--topic", "/rear")
    assert f"{packed}: unpacked to " in output and f"warning: {packed}" not in output


def test_frames_and_stamps_that_change(tmp_path: Path) -> None:
    messages = [(time_ns, laid_out(POINTS, time_ns=time_ns)) for time_ns in stamps(4)]
    messages[1][1].header = replace(messages[1][1].header, frame_id="other")
    messages[3] = messages[3][0], laid_out(POINTS, time_ns=stamps(4)[0])
    found = inspect_scans(write_mcap(tmp_path / "a.mcap", {"/lidar": messages}))
    assert "the scans are in 2 frames: lidar, other" in found.findings
    assert any(line.startswith("of 4 time stamps 1 go back") for line in found.findings)
