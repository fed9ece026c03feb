"""A second stage, and PV-RCNN in 8 bits, through the commands."""

import json
from pathlib import Path

import numpy as np
import pytest
import yaml

from asca_deploy import detect_archive
from asca_export.pv_rcnn import int8
from asca_pillars.base.errors import ConfigError
from asca_pillars.base.schema import to_dict
from asca_pillars.cli.detect import detect
from asca_pillars.cli.inspect import inspect
from asca_pillars.cli.train import prepare
from asca_pillars.models.build import load_checkpoint
from asca_pillars.scans.scan_reader import write_scan
from asca_pillars.training.loop import train
from tests.cli.local_cluster import Here
from tests.cli.short_drive import read_lines
from tests.data.boxes.box_scenes import write_box_dataset
from tests.export.pv_rcnn.random_checkpoint import CALIBRATION, random_checkpoint
from tests.export.tiny import SCANS
from tests.helpers.in_process import run_here
from tests.helpers.saved_checkpoint import save_checkpoint
from tests.helpers.scenes import write_dataset
from tests.models.two_stage.tiny_refine import tiny_refine_config, write_first_stage


def test_prepare_computes_the_proposals_that_training_reads(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    config = tiny_refine_config(write_first_stage(tmp_path / "first.ckpt"), epochs=1)
    root, path = write_box_dataset(tmp_path / "own", 6, val_frames=2), tmp_path / "refine.yaml"
    path.write_text(yaml.safe_dump(to_dict(config)))
    prepare(path, data=root)
    files = sorted((root / "prepared" / "scans").glob("proposals-*/*.npz"))
    assert len(files) == 6
    times = [file.stat().st_mtime_ns for file in files]
    checkpoint = load_checkpoint(train(config, root, tmp_path / "run"))
    assert not checkpoint.config.data.camera_view
    assert sorted(root.rglob("proposals-*/*.npz")) == files
    assert [file.stat().st_mtime_ns for file in files] == times, "none was computed again"

    inspect(write_dataset(tmp_path / "data", 3), config=path)
    assert "against tiny_refine: 2 of 2 frames" in " ".join(capsys.readouterr().out.split())
    with pytest.raises(ConfigError, match=r"--propose .*own\.yaml: classes of model.kind pillar_refine"):
        inspect(tmp_path / "data", config=path, propose=tmp_path / "own.yaml")
    assert not (tmp_path / "own.yaml").exists()


def write_scans(folder: Path, scans: list[np.ndarray]) -> Path:
    for number, points in enumerate(scans):
        write_scan(folder / f"{number}.bin", points)
    return folder


def test_an_8_bit_bundle_from_export_to_evaluation(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    scores = int8._scores
    monkeypatch.setattr(int8, "_scores", lambda pipeline, scans: scores(pipeline, scans[:1]))  # layers by one scan
    save_checkpoint(tmp_path / "last.ckpt", random_checkpoint())
    scans, bundle = write_scans(tmp_path / "scans", SCANS), tmp_path / "bundle"
    calibration = write_scans(tmp_path / "calibration", CALIBRATION)
    exported = run_here(
        *("export", tmp_path / "last.ckpt", "-o", bundle, "--scans", scans, "--int8", "--calibrate", calibration)
    )
    assert exported.returncode == 0, exported.stderr
    assert "parity on 8 scans" in exported.stdout and "calibrated on 8 scans" in exported.stdout
    assert "conv2_0" in exported.stdout and "blocks.0.0" in exported.stdout
    assert json.loads((bundle / "bundle.json").read_text())["precision"] == "int8"

    detected = run_here("detect", scans, "-b", bundle, "--out", tmp_path / "out", "--threads", 1, "--no-pictures")
    assert detected.returncode == 0, detected.stderr
    assert "cpu int8" in detected.stdout and len(list((tmp_path / "out").glob("*.json"))) == len(SCANS)
    monkeypatch.setattr(detect_archive, "run_shards", Here())
    monkeypatch.setattr(detect_archive, "require", lambda extra: None)
    detect([scans], out=tmp_path / "archive", bundle=bundle, cluster="made-up:1")
    assert read_lines(tmp_path / "out") == read_lines(tmp_path / "archive")
    monkeypatch.setattr("asca_deploy.benchmark.timing.gemm_rate", lambda kind, threads: 100.0)
    timed = run_here("bench", scans / "0.bin", "--bundle", bundle, "--rounds", 2, "--threads", 1)
    assert timed.returncode == 0 and "voxels" in timed.stdout, timed.stderr
    data = write_dataset(tmp_path / "data", 2)
    options = ("--out", tmp_path / "eval", "--threads", 1, "--gallery", 0, "--min-score", 0.01)
    evaluated = run_here("eval", bundle, "--data", data, *options)
    assert evaluated.returncode == 0, evaluated.stderr
