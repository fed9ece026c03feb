"""Programs that run `asca` rely on its errors, exit codes, JSON, deadlines and on what results say about the model."""

import errno
import json
import shutil
import subprocess
import sys
from pathlib import Path
from unittest.mock import MagicMock

import numpy as np
import pytest
import typer

from asca_deploy import Detector, default_bundle_path
from asca_pillars.base import errors
from asca_pillars.cli import doctor
from asca_pillars.cli.run_command import run_command
from asca_pillars.scans.scan_reader import write_scan
from tests.cli.short_drive import BUNDLE, POINTS, read_lines
from tests.helpers.in_process import run_here

DEPLOY = Path(__file__).parents[2] / "docs" / "guide" / "deploy.md"
KINDS: dict[int, set[type[errors.AscaError]]] = {
    2: {errors.ConfigError, errors.OutputError},
    3: {errors.PartialError},
    4: {errors.ScanError, errors.DatasetError, errors.BundleError, errors.ExportError, errors.TrainingError},
    5: {errors.AscaError, errors.ProviderError, errors.ClusterError, errors.WorkerError},
}


def failed(error: BaseException, name: str | None = "asca") -> int:
    """The exit code of a command with this error, of which it prints one line."""

    def fail() -> None:
        raise error

    app = typer.Typer()
    app.command()(fail)
    with pytest.MonkeyPatch.context() as patch, pytest.raises(SystemExit) as ended:
        patch.setattr("sys.argv", ["benchmarks/memory.py"])
        run_command(app, name)
    assert isinstance(ended.value.code, int)
    return ended.value.code


def test_every_kind_of_error_has_its_exit_code() -> None:
    classes = [one for one in vars(errors).values() if isinstance(one, type) and issubclass(one, errors.AscaError)]
    assert {kind for own in KINDS.values() for kind in own} == set(classes)
    for code, own in KINDS.items():
        assert {failed(kind("said")) for kind in own} == {code}
        assert f"| {code} |" in DEPLOY.read_text()
    assert failed(FileNotFoundError(errno.ENOENT, "no such file", "x")) == 4


@pytest.mark.parametrize(
    ("error", "line", "code"),
    [
        (errors.ScanError("a.pcd: TYPE \x1b[2J\n"), r"a.pcd: TYPE \x1b[2J\n", 4),
        (MemoryError("Unable to allocate 46.6 GiB"), "out of memory (Unable to allocate 46.6 GiB); ", 5),
        (RecursionError("deep"), "the input is nested too deeply", 4),
        (OSError(28, "No space left on device", "a.ckpt"), "a.ckpt: No space left on device", 5),
    ],
)
@pytest.mark.parametrize("name", ["asca", None])
def test_errors_are_one_line(
    error: Exception, line: str, code: int, name: str | None, capsys: pytest.CaptureFixture[str]
) -> None:
    assert failed(error, name) == code
    printed = capsys.readouterr().err
    assert printed.startswith(f"{name or 'memory'}: {line}") and printed.count("\n") == 1


def test_a_defect_keeps_its_traceback() -> None:
    with pytest.raises(ZeroDivisionError):
        failed(ZeroDivisionError())


def test_a_terminal_that_knows_ascii_only_gets_the_table(tmp_path: Path) -> None:
    np.save(tmp_path / "near.npy", POINTS)
    words = ["detect", str(tmp_path / "near.npy"), "-b", str(BUNDLE), "--no-pictures", "-o", str(tmp_path / "out")]
    environment = {"PYTHONIOENCODING": "ascii", "PYTHONPATH": ":".join(sys.path), "PATH": ""}
    command = [sys.executable, "-m", "asca_pillars.cli", *words]
    done = subprocess.run(command, env=environment, capture_output=True, check=False)
    assert done.returncode == 0, done.stderr.decode()
    assert b"heading" in done.stdout and b"?" in done.stdout


def test_a_scan_that_cannot_be_read_makes_a_run_partial(tmp_path: Path) -> None:
    scans, out = tmp_path / "scans", tmp_path / "out"
    write_scan(scans / "2.bin", np.ones((3, 4), np.float32))
    (scans / "1.bin").write_bytes(b"torn")
    done = run_here("detect", scans, "-b", BUNDLE, "--no-pictures", "--out", out, "--write", "openpcdet")
    assert done.returncode == 3, done.stderr
    assert [path.name for path in (out / "openpcdet").iterdir()] == ["2.txt"]
    (line,) = read_lines(out)
    assert line["made_by"] == Detector(BUNDLE).made_by
    assert set(line["made_by"]) == {"model", "weights_sha256", "version"}
    assert run_here("detect", tmp_path / "none.bin", cwd=tmp_path).returncode == 4
    assert run_here("detect", "--score", "Tram=1", cwd=tmp_path).returncode == 2


def test_doctor_as_json_says_whether_the_model_runs(monkeypatch: pytest.MonkeyPatch) -> None:
    done = run_here("doctor", "--json")
    assert done.returncode == 0
    checks = json.loads(done.stdout)
    assert checks["model"]["ok"] and checks["model"]["made_by"]["model"] == checks["model"]["name"] == "default"
    assert checks["providers"]["cpu"] == {"ok": True, "says": "ok"}
    assert set(checks["extras"]["train"]) == {"ok", "says"}
    monkeypatch.setattr(doctor, "_bundled_model", MagicMock(side_effect=errors.BundleError("damaged")))
    done = run_here("doctor")
    assert done.returncode == 1 and "damaged" in done.stdout


def test_a_deadline_is_judged(tmp_path: Path) -> None:
    write_scan(tmp_path / "1.bin", np.ones((3, 4), np.float32))
    command = ("bench", tmp_path / "1.bin", "--rounds", 2, "--bundle", "fast", "--deadline")
    late = run_here(*command, 0.001, "--late", 0.5, "--json", tmp_path / "report.json")
    assert late.returncode == 1 and "later than 0.001 ms: 100.0% of 2 frames" in late.stdout, late.stderr
    report = json.loads((tmp_path / "report.json").read_text())
    assert report["late_share"] == 1 and report["made_by"]["model"] == "fast"
    total = report["total_ms"]
    assert total["min"] <= total["p50"] <= total["p95"] <= total["p99"] <= total["max"]
    assert run_here(*command, 1e6, "--late", 0).returncode == 0


def test_bundles_are_listed_described_and_verified(tmp_path: Path) -> None:
    assert "default: pillar, int8, 3.4 MiB, Apache-2.0, the default" in run_here("bundle", "list").stdout
    about = json.loads(run_here("bundle", "info", "--json").stdout)
    assert about["weights_sha256"] == Detector().made_by["weights_sha256"]
    folder = shutil.copytree(default_bundle_path(), tmp_path / "bundle")
    whole = run_here("bundle", "verify", folder)
    assert whole.returncode == 0 and "whole; " in whole.stdout and not whole.stderr
    path = folder / "backbone.onnx"
    path.write_bytes(path.read_bytes()[:-1] + b"x")
    damaged = run_here("bundle", "verify", folder)
    assert damaged.returncode == 4 and "backbone.onnx is damaged" in damaged.stderr


def test_warm_up_changes_no_result(caplog: pytest.LogCaptureFixture) -> None:
    points = np.random.default_rng(1).uniform(0, 1, (2000, 4)).astype(np.float32) * [40, 8, 2, 1] - [0, 4, 2, 0]
    fresh, warm = Detector("fast"), Detector("fast")
    assert warm.warm_up(5000) > 0
    assert not caplog.records
    np.testing.assert_array_equal(warm(points).boxes, fresh(points).boxes)
