"""The functions behind the commands, called as a notebook calls them: results come back, nothing is printed."""

import dataclasses
from pathlib import Path

import pytest

from asca_pillars import (
    RuntimeOptions,
    ScanSettings,
    detect_recording,
    detect_scans,
    evaluate,
    export,
    load_bundle,
    simulate,
    train,
)
from asca_pillars.base.errors import ConfigError, ScanError
from asca_pillars.base.progress import Reporter
from asca_pillars.scans.scan_reader import write_scan
from tests.cli.short_drive import SCANS as DRIVE_SCANS
from tests.cli.short_drive import write_drive
from tests.deploy.conftest import make_scan, write_bundle
from tests.export.tiny import SCANS, tiny_checkpoint
from tests.helpers.saved_checkpoint import save_checkpoint
from tests.helpers.scenes import write_dataset
from tests.helpers.tiny_run import CONFIG


class Steps:
    """Remembers what a progress callback was told."""

    def __init__(self) -> None:
        self.told: list[tuple[str, int, int]] = []

    def __call__(self, step: str, done: int, total: int) -> None:
        self.told.append((step, done, total))

    def last_of(self, step: str) -> tuple[int, int]:
        return next((done, total) for name, done, total in reversed(self.told) if name == step)


@pytest.fixture
def bundle(tmp_path: Path) -> Path:
    return write_bundle(tmp_path / "tiny")


@pytest.fixture(autouse=True)
def printed(capsys: pytest.CaptureFixture[str]) -> pytest.CaptureFixture[str]:
    return capsys


def test_scans_without_files(bundle: Path, tmp_path: Path, printed: pytest.CaptureFixture[str]) -> None:
    for number in range(3):
        write_scan(tmp_path / "scans" / f"{number}.bin", make_scan(number, 300))
    (tmp_path / "scans" / "9.bin").write_bytes(b"torn")
    before = sorted(tmp_path.rglob("*"))
    steps = Steps()
    failed: list[str] = []
    found = detect_scans(
        tmp_path / "scans", options=RuntimeOptions(bundle=bundle, threads=1), progress=steps, failed=failed.append
    )
    assert [scan.path.name for scan in found] == ["0.bin", "1.bin", "2.bin"]
    assert all(len(scan.detections) == len(scan.detections.boxes) for scan in found)
    assert (len(found), found.unreadable, list(found.failed)) == (3, 1, failed)
    assert "9.bin" in failed[0] and "4 bytes" in failed[0]
    assert steps.told == [("Detecting", done, 4) for done in range(5)]
    again = Steps()  # progress begins where an earlier run ended
    assert list(Reporter(again).track(iter("ab"), "Detecting", 5, done=3)) == ["a", "b"]
    assert again.told[0] == ("Detecting", 3, 5) and again.last_of("Detecting") == (5, 5)
    assert sorted(tmp_path.rglob("*")) == before
    assert printed.readouterr().out == ""


def test_scans_with_files_and_settings(bundle: Path, tmp_path: Path) -> None:
    write_scan(tmp_path / "scan.bin", make_scan(0, 300))
    settings = ScanSettings(axes="y-forward", reflectance_scale=1.0)
    options = RuntimeOptions(bundle=bundle, threads=1)
    found = detect_scans(str(tmp_path / "scan.bin"), tmp_path / "out", options=options, reading=settings, score=0.01)
    assert {path.name for path in (tmp_path / "out").iterdir()} == {
        "scan.json",
        "scan_bev.png",
        "detections.jsonl",
        "index.html",
    }
    assert found.detector.mounting is not None and found.detector.mounting.axes == "y-forward"
    with pytest.raises(ScanError, match="nowhere"):
        detect_scans(tmp_path / "nowhere")


def test_a_recording(tmp_path: Path, printed: pytest.CaptureFixture[str]) -> None:
    pytest.importorskip("rosbags")
    drive = write_drive(tmp_path / "drive.mcap")
    steps = Steps()
    remarks: list[str] = []
    options = RuntimeOptions(threads=1)
    done = detect_recording(drive, tmp_path / "out", options=options, progress=steps, remark=remarks.append)
    assert done.scans == DRIVE_SCANS and sum(done.boxes.values()) > 0
    assert done.files == (tmp_path / "out" / "detections.jsonl",) and not done.problems
    assert steps.last_of("Detecting") == (DRIVE_SCANS, DRIVE_SCANS)
    assert list(done.remarks) == remarks and "/lidar: 5 scans" in remarks
    assert printed.readouterr().out == ""


def test_a_model_and_its_predictions_get_the_same_figures(tmp_path: Path, printed: pytest.CaptureFixture[str]) -> None:
    data = write_dataset(tmp_path / "kitti", 3, val_frames=2)
    checkpoint = tmp_path / "last.ckpt"
    save_checkpoint(checkpoint, tiny_checkpoint("none"))
    steps = Steps()
    scored = evaluate(checkpoint, data, tmp_path / "out", gallery=0, progress=steps)
    assert (scored.protocol, scored.errors) == ("kitti", None)
    assert steps.last_of("Detecting") == (2, 2) and "Matching" in {step for step, _, _ in steps.told}
    again = evaluate(data=data, out=tmp_path / "again", predictions=tmp_path / "out" / "predictions", protocol="waymo")
    assert again.report["frames_asked"] == scored.report["frames_asked"] == 2
    assert "| " in scored.page.markdown()
    assert printed.readouterr().out == ""
    with pytest.raises(ConfigError, match="--provider"):
        evaluate(
            data=data,
            out=tmp_path / "no",
            predictions=tmp_path / "out" / "predictions",
            options=RuntimeOptions(provider="cuda"),
        )


def test_simulated_scans_are_trained_on_and_exported(tmp_path: Path, printed: pytest.CaptureFixture[str]) -> None:
    steps = Steps()
    remarks: list[str] = []
    made = simulate(tmp_path / "sim", 1, view="camera", progress=steps)
    assert made.frames == len(list(made.scans.iterdir())) == 1 and steps.last_of("Simulating") == (1, 1)
    drives = simulate(tmp_path / "drives", sequences=1, length=2, config="vlp_16")
    assert drives.frames == len(list(drives.scans.rglob("*.bin"))) == 2
    assert printed.readouterr().out == ""

    data = write_dataset(tmp_path / "data", 3)
    train_config = dataclasses.replace(CONFIG.train, epochs=1)
    insert = dataclasses.replace(CONFIG.augment.insert, method="gt_aug")
    augment = dataclasses.replace(CONFIG.augment, insert=insert)
    config = dataclasses.replace(CONFIG, train=train_config, augment=augment)
    last = train(config, data, tmp_path / "run", progress=steps, remark=remarks.append)
    assert last.is_file() and steps.last_of("Training") == (1, 1)
    assert steps.last_of("Object database") == steps.last_of("Measuring training scans") == (2, 2)
    assert remarks
    assert printed.readouterr().out == ""

    for number, points in enumerate(SCANS):
        write_scan(tmp_path / "scans" / f"{number}.bin", points)
    doing: list[str] = []
    bundle = export(last, tmp_path / "bundle", scans=tmp_path / "scans", score=0.05, step=doing.append)
    assert bundle.parity is not None and bundle.parity.scans == len(SCANS) and doing
    assert load_bundle(tmp_path / "bundle").spec.classes[0].score_threshold == 0.05
    assert printed.readouterr().out == ""
