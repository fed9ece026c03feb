"""Nothing reports: no socket to the network is opened, and nothing is written beside what was asked for."""

import dataclasses
import importlib.util
import json
import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
import onnxruntime
import pytest
import yaml

from asca_deploy import onnx_runtime
from asca_pillars.base.schema import to_dict
from asca_pillars.base.telemetry import onnxruntime_may_report
from tests.helpers import socket_filter
from tests.helpers.bundles import DENSE_INT8
from tests.helpers.package_imports import PACKAGES, ROOT, imports
from tests.helpers.socket_filter import NOT_HERE

FILTER = Path(socket_filter.__file__)
KEPT = ("PATH", "PYTHONPATH", "LD_LIBRARY_PATH", "OPENBLAS_CORETYPE")
"""Of the environment. What tells onnxruntime that it is tested, such as CI, makes it keep still."""
CACHES = (".cache/numba", ".cache/matplotlib", ".config/matplotlib")
"""Below the home folder: compiled functions where the package's own folder cannot be written, and a list of fonts."""
IMPORTERS = {
    "asca_deploy/onnx_runtime.py": "onnxruntime",
    "asca_export/int8.py": "onnxruntime.quantization",  # its package has imported the former
}


def test_onnxruntime_is_imported_in_one_place() -> None:
    found = {
        path.relative_to(package.parent).as_posix(): names
        for package in (*PACKAGES, ROOT / "benchmarks")
        for path in package.rglob("*.py")
        if (names := [name for name in imports(path) if name.split(".")[0] == "onnxruntime"])
    }
    assert set(found) == set(IMPORTERS)
    assert all(name.startswith(IMPORTERS[path]) for path, names in found.items() for name in names)
    assert list(imports(ROOT / "export" / "asca_export" / "__init__.py")) == ["asca_deploy.onnx_runtime"]
    pages = [*(ROOT / "docs").rglob("*.md"), ROOT / "README.md"]
    assert len(pages) > 20
    assert [page.name for page in pages if "import onnxruntime" in page.read_text(encoding="utf-8")] == []


@pytest.mark.parametrize(
    ("stated", "expected", "may_report"),
    [(None, "1", False), ("", "1", False), ("0", "0", True), ("true", "true", False)],
)
def test_what_the_user_has_set_stays(
    monkeypatch: pytest.MonkeyPatch, stated: str | None, expected: str, may_report: bool
) -> None:
    monkeypatch.setenv("RAY_USAGE_STATS_ENABLED", "1")
    monkeypatch.delenv("ORT_DISABLE_TELEMETRY", raising=False)
    if stated is not None:
        monkeypatch.setenv("ORT_DISABLE_TELEMETRY", stated)
    calls: list[int] = []
    monkeypatch.setattr(onnxruntime, "disable_telemetry_events", lambda: calls.append(1))
    importlib.reload(onnx_runtime)  # as where the caller has imported onnxruntime before
    assert os.environ["ORT_DISABLE_TELEMETRY"] == expected and os.environ["RAY_USAGE_STATS_ENABLED"] == "1"
    assert onnxruntime_may_report() == may_report and len(calls) == (not may_report)
    if stated is None:
        monkeypatch.delenv("ORT_DISABLE_TELEMETRY")
    monkeypatch.delitem(sys.modules, "onnxruntime")
    monkeypatch.setattr(sys, "meta_path", [seen := Watch(), *sys.meta_path])
    with pytest.raises(ModuleNotFoundError):
        importlib.reload(onnx_runtime)
    assert seen.stated == expected, "before onnxruntime is imported"


class Watch:
    """Records what the environment states when onnxruntime is imported, and lets the import fail."""

    stated: str | None = None

    def find_spec(self, name: str, *_: object) -> None:
        if name == "onnxruntime":
            self.stated = os.environ.get("ORT_DISABLE_TELEMETRY")
            raise ModuleNotFoundError(name)


def run(
    command: list[Any], environment: dict[str, str] | None = None, cwd: Path | None = None
) -> subprocess.CompletedProcess[str]:
    kept = {name: os.environ[name] for name in KEPT if name in os.environ}
    return subprocess.run(
        list(map(str, command)), capture_output=True, text=True, timeout=300, cwd=cwd, env=kept | (environment or {})
    )


@pytest.fixture(scope="module")
def _filtered() -> None:
    for code in ("socket.socket(socket.AF_INET)", "socket.gethostbyname('example.org')"):  # a socket, a host's address
        seen = run([sys.executable, FILTER, sys.executable, "-c", f"import socket; {code}"])
        if seen.returncode == NOT_HERE:
            pytest.skip("needs Linux that lets a process filter its own system calls (seccomp)")
        assert seen.returncode == -signal.SIGSYS, code


class Fresh:
    """A home folder, a folder for temporary files and one to work in, all empty."""

    def __init__(self, root: Path) -> None:
        self.home, self.temporary, self.work = (root / name for name in ("home", "tmp", "work"))
        for folder in (self.home, self.temporary, self.work):
            folder.mkdir(parents=True)

    def run(self, *command: Any, **environment: str) -> subprocess.CompletedProcess[str]:
        places = {"HOME": str(self.home), "TMPDIR": str(self.temporary), "PYTHONDONTWRITEBYTECODE": "1"}
        return run([sys.executable, FILTER, *command], places | environment, self.work)

    def files(self) -> Iterator[Path]:
        """All but those of the caches, relative to the root."""
        for folder in (self.home, self.temporary, self.work):
            for path in folder.rglob("*"):
                name = path.relative_to(folder).as_posix()
                if path.is_file() and not (folder == self.home and name.startswith(CACHES)):
                    yield path.relative_to(self.home.parent)


@pytest.fixture
def fresh(tmp_path: Path, _filtered: None) -> Fresh:
    return Fresh(tmp_path / "fresh")


COMMANDS = """
import importlib, json, os, sys, time

class Watch:
    def find_spec(self, name, path=None, target=None):
        if name == "onnxruntime":
            assert os.environ.get("ORT_DISABLE_TELEMETRY") == "1", "it is imported with its telemetry on"
            seen.append(time.monotonic())

seen = []
sys.meta_path.insert(0, Watch())
_, first, commands, wait_s = sys.argv
importlib.import_module(first)
from asca_pillars.cli.main import main
for command in json.loads(commands):
    print(*command, flush=True)
    sys.argv = ["asca", *command]
    try:
        main()
    except SystemExit as end:
        if end.code:
            raise
time.sleep(max(0, seen[0] + float(wait_s) - time.monotonic()))
"""
REPORT_S = 12.0
"""onnxruntime 1.32 opens its first socket nine seconds after it was imported."""


def asca(first: str, *commands: tuple[object, ...], wait_s: float = 0) -> tuple[str, ...]:
    """A process that imports the module `first`, runs `asca COMMAND` for one after the other and waits for reports.

    One process, because to start costs more than the commands do.
    """
    listed = json.dumps([list(map(str, command)) for command in commands])
    return sys.executable, "-c", COMMANDS, first, listed, str(wait_s)


def test_commands_of_the_runtime(fresh: Fresh, tmp_path: Path) -> None:
    """Reports would be seen, where a process has imported onnxruntime for long."""
    commands = ["detect -o out/detect", "bench --rounds 1 --json out/bench.json", "doctor"]
    if importlib.util.find_spec("openvino") is not None:
        commands.append(f"detect -o out/openvino -b {DENSE_INT8} --provider openvino")
    (fresh.work / "out").mkdir()
    reporting = Fresh(tmp_path / "reporting")
    with ThreadPoolExecutor() as pool:
        sleeps = f"import asca_deploy, time; time.sleep({2 * REPORT_S})"
        would = pool.submit(reporting.run, sys.executable, "-c", sleeps, ORT_DISABLE_TELEMETRY="0")
        result = fresh.run(*asca("asca_deploy", *(tuple(command.split()) for command in commands), wait_s=REPORT_S))
        assert result.returncode == 0, f"{result.stdout}{result.stderr}"
        assert json.loads((fresh.work / "out/bench.json").read_text())
        assert [path for path in fresh.files() if not path.as_posix().startswith("work/out/")] == []
        if not onnxruntime.__version__.startswith("1.32."):
            pytest.skip("the other half is about what onnxruntime 1.32 does")
        assert would.result().returncode == -signal.SIGSYS
    assert any(path.name == "deviceid" for path in reporting.files())


def test_training_and_export(fresh: Fresh, tmp_path: Path) -> None:
    from asca_pillars.config.pillar import PillarModel
    from tests.export.tiny import SCANS
    from tests.helpers.scenes import SPEC, write_dataset
    from tests.helpers.tiny_run import CONFIG, NETWORK

    data, scans = write_dataset(tmp_path / "data", 3), tmp_path / "scans"
    scans.mkdir()
    for number, points in enumerate(SCANS):
        np.save(scans / f"{number}.npy", points)
    model = PillarModel(spec=SPEC, network=dataclasses.replace(NETWORK, cpa="none"))
    config = dataclasses.replace(CONFIG, model=model, train=dataclasses.replace(CONFIG.train, epochs=1))
    (tmp_path / "tiny.yaml").write_text(yaml.safe_dump(to_dict(config)))
    commands = asca(
        "asca_pillars.training.loop",
        ("train", tmp_path / "tiny.yaml", "--data", data, "--out", "run"),
        ("export", "run/checkpoints/last.ckpt", "--scans", scans, "-o", "bundle"),
    )
    result = fresh.run(*commands)
    assert result.returncode == 0, f"{result.stdout}{result.stderr}"
    assert {path.parts[:2] for path in fresh.files()} == {("work", "run"), ("work", "bundle")}
