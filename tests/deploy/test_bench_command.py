import json
import logging
import shutil
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from typer.testing import CliRunner

from asca_deploy import Detector
from asca_pillars.base.errors import BundleError, ConfigError, OutputError, ScanError
from asca_pillars.cli.main import app
from asca_pillars.scans.scan_reader import write_scan
from tests.scans.recordings.cloud_recordings import clouds, write_mcap

Points = NDArray[np.float32]


@pytest.fixture(autouse=True)
def _fast_machine_in_a_process_of_its_own(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    monkeypatch.setattr("asca_deploy.benchmark.roofline.gemm_rate", lambda kind, threads: 100.0)
    monkeypatch.setenv("COLUMNS", "120")
    logger = logging.getLogger("asca_pillars")
    level = logger.level
    yield
    logger.setLevel(level)  # the command silences it for the rest of its process


def test_all_parts_are_printed_and_written(tiny_bundle: Path, bundle_copy: Path, scan: Points, tmp_path: Path) -> None:
    write_scan(tmp_path / "scan.bin", scan)
    other = shutil.copytree(bundle_copy, tmp_path / "other")
    command = ["bench", tmp_path / "scan.bin", "-b", tiny_bundle, "--compare", other, "--matrix", "--scaling"]
    command += ["--stream", "--rounds", 1, "--json", tmp_path / "report.json"]
    result = CliRunner().invoke(app, [str(part) for part in command], catch_exceptions=False)
    assert result.exit_code == 0
    for text in ("neck+head", "outside the graphs", "roofline", "times as fast", "precision", "stream", "pillars"):
        assert text in result.output
    report = json.loads((tmp_path / "report.json").read_text())
    assert report["fps"] == pytest.approx(1000 / report["total_ms"]["p50"])
    assert 0 < report["outside_share"] < 1
    assert report["roofline"]["gemm_gmac_s"] == {"float32": 100, "int8": 100}
    assert [one["name"] for one in report["compare"]["contestants"]] == ["tiny", "other"]
    assert report["compare"]["boxes"]["other"]["lone"] == 0, "it is a copy"
    assert report["compare"]["boxes"]["other"]["pairs"] > 0 and "without a partner" in result.output
    assert {row["way"]["bundle"] for row in report["matrix"]} == {"tiny", "other"}
    assert len(report["scaling"]) > 1 and report["stream"]["stream_fps"] > 0


def test_a_recording_is_timed(tiny_bundle: Path, tmp_path: Path) -> None:
    pytest.importorskip("rosbags", reason="needs pip install -e '.[recordings]'")
    path = write_mcap(tmp_path / "drive.mcap", {"/lidar": clouds(3), "/other": clouds(1)})
    command = ["bench", str(path), "-b", str(tiny_bundle), "--rounds", "1"]
    assert isinstance(CliRunner().invoke(app, command).exception, ScanError), "which topic?"
    result = CliRunner().invoke(app, [*command, "--topic", "/lidar"], catch_exceptions=False)
    assert "timing the first 3 scans with points" in result.output
    for wrong in ([str(path), str(path)], ["--topic", "/lidar"]):
        assert isinstance(CliRunner().invoke(app, ["bench", *wrong]).exception, ConfigError)


def test_json_replaces_its_own_report_alone(tiny_bundle: Path, scan: Points, tmp_path: Path) -> None:
    write_scan(tmp_path / "scan.bin", scan)
    command = ["bench", tmp_path / "scan.bin", "-b", tiny_bundle, "--rounds", 1, "--json"]
    for _ in range(2):
        CliRunner().invoke(app, [*map(str, command), str(tmp_path / "report.json")], catch_exceptions=False)
    (tmp_path / "evaluation.json").write_text('{"subject": "x", "fps": 1}')
    (tmp_path / "link.json").symlink_to(tmp_path / "report.json")
    for name in ("evaluation.json", "scan.bin", "link.json", f"{tiny_bundle}/bundle.json"):
        before = (tmp_path / name).read_bytes()
        with pytest.raises(OutputError, match=r"`asca bench` did not write it|is a link"):
            CliRunner().invoke(app, [*map(str, command), str(tmp_path / name)], catch_exceptions=False)
        assert (tmp_path / name).read_bytes() == before


def test_a_bundle_is_not_compared_with_itself(tiny_bundle: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tiny_bundle.parent)
    for others in ([tiny_bundle], [Path(tiny_bundle.name), "default_float32"]):
        options = [part for other in others for part in ("--compare", str(other))]
        with pytest.raises(ConfigError, match=f"--compare {others[0]}: a bundle is compared with itself"):
            CliRunner().invoke(app, ["bench", "-b", str(tiny_bundle), *options], catch_exceptions=False)


def test_a_bundle_to_compare_with_is_looked_at_first(
    tiny_bundle: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("asca_pillars.cli.bench_parts.benchmark", lambda *_, **__: pytest.fail("too late"))
    with pytest.raises(BundleError, match="none: no such folder"):
        CliRunner().invoke(
            app, ["bench", "-b", str(tiny_bundle), "--compare", str(tmp_path / "none")], catch_exceptions=False
        )


def test_a_file_that_cannot_be_written_is_told_before_the_work(
    tiny_bundle: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("asca_pillars.cli.bench_parts.benchmark", lambda *_, **__: pytest.fail("too late"))
    with pytest.raises(OutputError, match="is a folder"):
        CliRunner().invoke(app, ["bench", "-b", str(tiny_bundle), "--json", str(tmp_path)], catch_exceptions=False)


def test_the_roofline_is_that_of_one_pass(tiny_bundle: Path, tmp_path: Path) -> None:
    command = ["bench", "-b", tiny_bundle, "--around", "--rounds", 1, "--json", tmp_path / "report.json"]
    result = CliRunner().invoke(app, [str(part) for part in command], catch_exceptions=False)
    assert result.exit_code == 0
    report = json.loads((tmp_path / "report.json").read_text())
    passes = Detector(tiny_bundle, view="around").passes
    per_pass_s = report["stages_ms"]["neck+head"]["p50"] / 1e3 / passes
    assert passes > 1
    assert report["roofline"]["achieved_gmac_s"] == pytest.approx(report["roofline"]["gmac"] / per_pass_s)


def test_a_scan_with_nothing_to_compute_has_no_roofline(tiny_bundle: Path, tmp_path: Path) -> None:
    np.save(tmp_path / "far.npy", np.array([[-500, 0, 0, 0.5]], np.float32))
    command = ["bench", tmp_path / "far.npy", "-b", tiny_bundle, "--rounds", 1, "--json", tmp_path / "report.json"]
    result = CliRunner().invoke(app, [str(part) for part in command], catch_exceptions=False)
    assert result.exit_code == 0 and "no roofline" in result.output
    assert "roofline" not in json.loads((tmp_path / "report.json").read_text())


@pytest.mark.parametrize("name", ["default", "asca_sim_int8"])
def test_a_bundle_that_ships_goes_by_its_name(name: str) -> None:
    with pytest.raises(ConfigError, match="compared with itself"):
        CliRunner().invoke(app, ["bench", "--compare", name], catch_exceptions=False)


def test_of_many_scans_some_are_timed(
    tiny_bundle: Path, scan: Points, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("asca_pillars.cli.bench.MOST_SCANS", 3)
    for number in range(7):
        write_scan(tmp_path / "scans" / f"{number}.bin", scan[: 1000 - number])
    command = ["bench", str(tmp_path / "scans"), "-b", str(tiny_bundle), "--rounds", "1", "--json"]
    result = CliRunner().invoke(app, [*command, str(tmp_path / "report.json")], catch_exceptions=False)
    assert "timing 3 of the 7 scans, evenly spaced" in result.output and "3 scan(s)" in result.output
    assert json.loads((tmp_path / "report.json").read_text())["points"] == [1000, 997, 994]
