import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from asca_deploy import Detector
from asca_pillars.base.errors import BundleError, ConfigError, OutputError, ScanError
from asca_pillars.scans.scan_reader import write_scan
from tests.helpers.in_process import invoke
from tests.scans.recordings.cloud_recordings import clouds, write_mcap

Points = NDArray[np.float32]


@pytest.fixture(autouse=True)
def _fast_machine(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("asca_deploy.benchmark.timing.gemm_rate", lambda kind, threads: 100.0)
    monkeypatch.setenv("COLUMNS", "120")


def test_all_parts_are_printed_and_written(tiny_bundle: Path, bundle_copy: Path, scan: Points, tmp_path: Path) -> None:
    write_scan(tmp_path / "scan.bin", scan)
    other = shutil.copytree(bundle_copy, tmp_path / "other")
    options = ("--compare", other, "--matrix", "--scaling", "--stream", "--json", tmp_path / "report.json")
    output = invoke("bench", tmp_path / "scan.bin", "-b", tiny_bundle, "--rounds", 1, *options)
    for text in ("neck+head", "outside the graphs", "roofline", "times as fast", "precision", "stream", "pillars"):
        assert text in output
    report = json.loads((tmp_path / "report.json").read_text())
    assert report["fps"] == pytest.approx(1000 / report["total_ms"]["p50"])
    assert 0 < report["outside_share"] < 1
    assert report["roofline"]["gemm_gmac_s"] == {"float32": 100, "int8": 100}
    assert [one["name"] for one in report["compare"]["contestants"]] == ["tiny", "other"]
    assert report["compare"]["boxes"]["other"]["lone"] == 0, "it is a copy"
    assert report["compare"]["boxes"]["other"]["pairs"] > 0 and "without a partner" in output
    assert {row["way"]["bundle"] for row in report["matrix"]} == {"tiny", "other"}
    assert len(report["scaling"]) > 1 and report["stream"]["stream_fps"] > 0


def test_a_recording_is_timed(tiny_bundle: Path, tmp_path: Path) -> None:
    pytest.importorskip("rosbags", reason="needs pip install -e '.[recordings]'")
    path = write_mcap(tmp_path / "drive.mcap", {"/lidar": clouds(3), "/other": clouds(1)})
    command = ["bench", path, "-b", tiny_bundle, "--rounds", 1]
    with pytest.raises(ScanError, match="--topic"):
        invoke(*command)
    assert "timing the first 3 scans with points" in invoke(*command, "--topic", "/lidar")
    for wrong in ([path, path], ["--topic", "/lidar"]):
        with pytest.raises(ConfigError):
            invoke("bench", *wrong)


def test_json_replaces_its_own_report_alone(tiny_bundle: Path, scan: Points, tmp_path: Path) -> None:
    write_scan(tmp_path / "scan.bin", scan)
    command = ["bench", tmp_path / "scan.bin", "-b", tiny_bundle, "--rounds", 1, "--json"]
    for _ in range(2):
        invoke(*command, tmp_path / "report.json")
    (tmp_path / "evaluation.json").write_text('{"subject": "x", "fps": 1}')
    (tmp_path / "link.json").symlink_to(tmp_path / "report.json")
    for name in ("evaluation.json", "scan.bin", "link.json", f"{tiny_bundle}/bundle.json"):
        before = (tmp_path / name).read_bytes()
        with pytest.raises(OutputError, match=r"`asca bench` did not write it|is a link"):
            invoke(*command, tmp_path / name)
        assert (tmp_path / name).read_bytes() == before


def test_a_bundle_is_not_compared_with_itself(tiny_bundle: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tiny_bundle.parent)
    for first, others in (
        ([], ["default"]),
        ([], ["asca_sim_int8"]),  # an earlier name of it
        (["-b", tiny_bundle], [tiny_bundle]),
        (["-b", tiny_bundle], [tiny_bundle.name, "default_float32"]),
    ):
        options = [part for other in others for part in ("--compare", other)]
        with pytest.raises(ConfigError, match=f"--compare {others[0]}: a bundle is compared with itself"):
            invoke("bench", *first, *options)


def test_what_cannot_work_is_told_before_the_work(
    tiny_bundle: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("asca_pillars.cli.bench_parts.benchmark", lambda *_, **__: pytest.fail("too late"))
    with pytest.raises(BundleError, match="none: no such folder"):
        invoke("bench", "-b", tiny_bundle, "--compare", tmp_path / "none")
    with pytest.raises(OutputError, match="is a folder"):
        invoke("bench", "-b", tiny_bundle, "--json", tmp_path)
    with pytest.raises(ConfigError, match="single passes"):
        invoke("bench", "--around", "--matrix")


def test_the_roofline_is_that_of_one_pass(tiny_bundle: Path, tmp_path: Path) -> None:
    invoke("bench", "-b", tiny_bundle, "--around", "--rounds", 1, "--json", tmp_path / "report.json")
    report = json.loads((tmp_path / "report.json").read_text())
    passes = Detector(tiny_bundle, view="around").passes
    per_pass_s = report["stages_ms"]["neck+head"]["p50"] / 1e3 / passes
    assert passes > 1
    assert report["roofline"]["achieved_gmac_s"] == pytest.approx(report["roofline"]["gmac"] / per_pass_s)


def test_a_scan_with_nothing_to_compute_has_no_roofline(tiny_bundle: Path, tmp_path: Path) -> None:
    np.save(tmp_path / "far.npy", np.array([[-500, 0, 0, 0.5]], np.float32))
    options = ("--rounds", 1, "--json", tmp_path / "report.json")
    assert "no roofline" in invoke("bench", tmp_path / "far.npy", "-b", tiny_bundle, *options)
    assert "roofline" not in json.loads((tmp_path / "report.json").read_text())


def test_of_many_scans_some_are_timed(
    tiny_bundle: Path, scan: Points, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("asca_pillars.cli.bench.MOST_SCANS", 3)
    for number in range(7):
        write_scan(tmp_path / "scans" / f"{number}.bin", scan[: 1000 - number])
    options = ("-b", tiny_bundle, "--rounds", 1, "--json", tmp_path / "report.json")
    output = invoke("bench", tmp_path / "scans", *options)
    assert "timing 3 of the 7 scans, evenly spaced" in output and "3 scan(s)" in output
    assert json.loads((tmp_path / "report.json").read_text())["points"] == [1000, 997, 994]


def test_in_wider_ranges_there_is_no_roofline() -> None:
    output = invoke("bench", "-b", "fast", "--around", "--rounds", 1)
    assert "no roofline" in output and "GMAC/s" not in output
