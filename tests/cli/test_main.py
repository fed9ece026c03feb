"""The command `asca` as a user meets it: what it prints, what it writes, and how it refuses."""

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml
from rich.text import Text
from typer.main import get_command

from asca_deploy import Detector, sample_scan_path
from asca_pillars.base.installation import install_command
from asca_pillars.base.schema import to_dict
from asca_pillars.cli.main import app
from asca_pillars.scans.scan_reader import read_scan, write_scan
from tests.helpers.hidden_modules import hiding
from tests.helpers.in_process import run_here
from tests.helpers.scenes import make_scene, write_dataset
from tests.helpers.tiny_run import CONFIG

HEAVY = "torch lightning onnx onnxscript tensorboard sklearn scipy matplotlib openvino rosbags mcap rerun ray"
WITHOUT_TORCH = hiding(HEAVY, "from asca_pillars.cli.main import main\nmain()")
IN_TURN = hiding(
    HEAVY,
    """
import contextlib
from asca_pillars.cli.main import main
for command in sys.argv[1:]:
    sys.argv = ["asca", *command.split()]
    with contextlib.suppress(SystemExit):
        main()
""",
)


def asca(*arguments: object, cwd: Path | None = None, code: str = WITHOUT_TORCH) -> subprocess.CompletedProcess:
    """Run the command in its own process; without `code` of its own, torch cannot be imported there."""
    environment = os.environ | {"COLUMNS": "120", "NO_COLOR": "1"}
    command = [sys.executable, "-c", code, *map(str, arguments)]
    return subprocess.run(command, cwd=cwd, capture_output=True, text=True, env=environment)


def refusal(result: subprocess.CompletedProcess) -> str:
    """The one line with which a command refused."""
    assert result.returncode in (2, 3, 4, 5), result.stdout + result.stderr
    lines = result.stderr.strip().splitlines()
    assert len(lines) == 1 and lines[0].startswith("asca: "), result.stderr
    return lines[0]


def test_help_says_all_that_is_written() -> None:
    """Words in brackets are styles to rich, which drops those that it does not know."""
    commands = get_command(app).commands.items()  # type: ignore[attr-defined]
    assert len(commands) > 5
    for name, command in commands:
        for each in (command, *command.params):
            written = each.help or ""
            assert Text.from_markup(written).plain == written.replace("\\[", "["), f"{name} {each.name}"


def test_help_loads_nothing_heavy() -> None:
    code = (
        "import sys; from typer.testing import CliRunner; from asca_pillars.cli.main import app\n"
        "result = CliRunner().invoke(app, ['--help']); assert result.exit_code == 0, result.output\n"
        "print(result.output)\n"
        "heavy = {'numpy', 'cv2', 'onnxruntime', 'torch', 'pydantic', 'yaml'} & set(sys.modules)\n"
        "assert not heavy, heavy"
    )
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert result.returncode == 0, result.stderr
    for command in ("detect", "bench", "simulate", "inspect", "prepare", "train", "eval", "export", "ablate", "doctor"):
        assert command in result.stdout


@pytest.mark.skipif(sys.platform == "win32", reason="Windows knows no limit on the size of files")
def test_detect_finds_boxes_without_torch_and_a_full_disk_loses_none_of_them(tmp_path: Path) -> None:
    result = asca("detect", "-b", "fast", cwd=tmp_path)
    assert result.returncode == 0, result.stderr
    assert "Car" in result.stdout and "FPS" in result.stdout and "pillarize" in result.stdout
    out = tmp_path / "detections"
    before = {path.name: path.read_bytes() for path in out.iterdir()}
    assert before.keys() == {"detections.jsonl", "index.html", "street.json", "street_bev.png"}
    boxes = json.loads(before["street.json"])["boxes"]
    expected = Detector("fast")(read_scan(sample_scan_path()).points)
    assert [box["class"] for box in boxes] == expected.names and len(boxes) >= 3
    assert np.asarray(cv2.imread(str(out / "street_bev.png"))).shape[1] >= 500
    limit = "import resource; resource.setrlimit(resource.RLIMIT_FSIZE, (200, 200))\n"  # a write beyond it fails
    assert "File too large" in refusal(asca("detect", "-b", "fast", cwd=tmp_path, code=limit + WITHOUT_TORCH))
    assert {path.name: path.read_bytes() for path in out.iterdir()} == before


def test_without_the_extras_commands_say_what_to_install(tmp_path: Path) -> None:
    (tmp_path / "config.yaml").write_text("name: x\n")
    commands = "doctor", "train config.yaml --data . --out run", "export last.ckpt -o bundle"
    result = asca(*commands, cwd=tmp_path, code=IN_TURN)
    assert "provider cpu: ok" in result.stdout and "auto takes cpu int8" in result.stdout
    assert install_command("train") in result.stdout and install_command("cluster") in result.stdout
    assert f"provider openvino is not installed: `{install_command('openvino')}`" in result.stdout
    refused = result.stderr.splitlines()
    assert len(refused) == 2 and all(install_command("train") in line for line in refused), result.stderr


def test_detect_refuses_in_one_line(tmp_path: Path) -> None:
    (tmp_path / "detections").write_text("keep me")
    for name in ("truncated.bin", "scan.e57"):
        (tmp_path / name).write_bytes(b"x")
    for arguments, message in (
        (("truncated.bin", "--out", "out"), "truncated.bin: file size (1 byte)"),
        (("scan.e57", "--out", "out"), "unknown suffix '.e57'"),
        (("none.bin", "--out", "out"), "no such file or folder"),
        (("--bundle", tmp_path), "bundle.json"),
        (("--provider", "gpu"), "unknown provider 'gpu'"),
        (("--precision", "half"), "unknown precision 'half'"),
        (("--threads", 0), "threads"),
        (("-b", "fast"), "detections"),
    ):
        assert message in refusal(run_here("detect", *arguments, cwd=tmp_path))
    assert not (tmp_path / "out").exists() and (tmp_path / "detections").read_text() == "keep me"


def test_a_scan_without_points_gives_no_boxes(tmp_path: Path) -> None:
    np.save(tmp_path / "empty.npy", np.empty((0, 4), np.float32))
    result = run_here("detect", "empty.npy", "-b", "fast", cwd=tmp_path)
    assert result.returncode == 0, result.stderr
    assert json.loads((tmp_path / "detections" / "empty.json").read_text())["boxes"] == []


def test_train_refuses_typos_and_missing_data(tmp_path: Path) -> None:
    config = tmp_path / "config.yaml"
    config.write_text("train: {epoch: 3}\n")
    command = ("train", config, "--data", tmp_path, "--out", tmp_path / "run")
    assert "unknown key `train.epoch`; did you mean `epochs`?" in refusal(run_here(*command))
    config.write_text("name: x\n")
    assert "did you mean `batch_size`?" in refusal(run_here(*command, "-s", "train.batchsize=2"))
    assert "velodyne" in refusal(run_here(*command))
    assert not (tmp_path / "run").exists()


def test_from_training_to_boxes(tmp_path: Path) -> None:
    """train, export, detect: every command takes what the one before it wrote."""
    data = write_dataset(tmp_path / "data", 4)
    (tmp_path / "config.yaml").write_text(yaml.safe_dump(to_dict(CONFIG)))
    run, bundle = tmp_path / "run", tmp_path / "bundle"
    trained = run_here("train", tmp_path / "config.yaml", "--data", data, "--out", run, "-s", "train.epochs=1")
    assert trained.returncode == 0, trained.stderr
    scans = tmp_path / "scans"
    for seed in range(8):
        write_scan(scans / f"{seed}.bin", make_scene(seed)[0])
    export = ("export", run / "checkpoints" / "last.ckpt", "-o", bundle, "--scans", scans)

    assert "Pedestrain: no such class; available:" in refusal(run_here(*export, "--score", "Pedestrain=0.2"))
    exported = run_here(*export, "--score", "Pedestrian=0.21", "--with-weights")
    assert exported.returncode == 0, exported.stderr
    assert (bundle / "weights.ckpt").read_bytes() == (run / "checkpoints" / "weights.ckpt").read_bytes()
    shutil.copytree(bundle, tmp_path / "torn")
    with (tmp_path / "torn" / "weights.ckpt").open("r+b") as file:
        file.seek(3000)
        file.write(b"bits")
    torn = run_here("export", tmp_path / "torn", "-o", tmp_path / "of_torn", "--scans", scans)
    assert "weights.ckpt: is damaged, or of another bundle" in refusal(torn)
    assert "parity on 8 scans" in exported.stdout
    manifest = json.loads((bundle / "bundle.json").read_text())
    assert manifest["provenance"]["command"].startswith("asca train")
    before = {spec.name: spec.score_threshold for spec in CONFIG.model.spec.classes}
    after = {spec["name"]: spec["score_threshold"] for spec in manifest["spec"]["classes"]}
    assert after == before | {"Pedestrian": 0.21}
    assert "add --int8" in refusal(run_here(*export, "--calibrate", scans))
    others = tmp_path / "others"
    for seed in range(7, 16):  # the first is among the scans of parity
        write_scan(others / f"{seed}.bin", make_scene(seed)[0])
    quantized = run_here(*export, "--int8", "--calibrate", others)
    assert quantized.returncode == 0, quantized.stderr
    assert "1 calibration scans left out" in quantized.stdout
    assert "calibrated on 8 scans" in quantized.stdout and "logit error" in quantized.stdout.lower()
    assert json.loads((bundle / "bundle.json").read_text())["precision"] == "int8"
    assert not (bundle / "weights.ckpt").exists()
    detected = run_here("detect", scans, "--bundle", bundle, "--out", tmp_path / "out", "--no-pictures")
    assert detected.returncode == 0 and len(list((tmp_path / "out").glob("*.json"))) == 8, detected.stderr


def test_simulated_frames_are_what_detect_reads(tmp_path: Path) -> None:
    result = run_here("simulate", "sim", "-n", 2, "--view", "camera", "-w", 1, cwd=tmp_path)
    assert result.returncode == 0, result.stderr
    detected = run_here("detect", "sim/training/velodyne", "-b", "fast", "--no-pictures", cwd=tmp_path)
    assert detected.returncode == 0, detected.stderr
    assert sorted(path.name for path in (tmp_path / "detections").glob("*.txt")) == ["000000.txt", "000001.txt"]
    assert "view" in refusal(run_here("simulate", "other", "--view", "rear", cwd=tmp_path))


def test_the_command_is_installed_and_says_its_version() -> None:
    result = run_here("--version")
    assert result.returncode == 0 and result.stdout.strip().count(".") == 2
    assert shutil.which("asca", path=str(Path(sys.executable).parent))
