"""`asca export` on checkpoints and on bundles that hold their weights: what is written, and what is refused."""

import dataclasses
import shutil
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from asca_deploy import Detector
from asca_deploy.manifest import load_pillar_bundle
from asca_pillars.base.files import WEIGHTS_FILE
from asca_pillars.models.build import load_checkpoint
from asca_pillars.models.checkpoint_file import weights_sha256
from asca_pillars.ops.pillar.grid import PillarGrid
from asca_pillars.scans.scan_reader import write_scan
from tests.export.tiny import SCANS, sparse_checkpoint, tiny_checkpoint
from tests.helpers.in_process import invoke, run_here
from tests.helpers.saved_checkpoint import save_checkpoint
from tests.helpers.scenes import SPEC


@pytest.fixture(scope="module")
def scans(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("scans")
    for number, points in enumerate(SCANS):
        write_scan(folder / f"{number}.bin", points)
    return folder


@pytest.fixture(scope="module")
def with_weights(scans: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("export")
    save_checkpoint(folder / "last.ckpt", sparse_checkpoint("fine"))
    options = ("--with-weights", "--score", "Car=0.05", "--trained-on", "random numbers")
    invoke("export", folder / "last.ckpt", "-o", folder / "bundle", "--scans", scans, *options)
    return folder / "bundle"


def test_a_bundle_with_its_weights_gets_a_dense_neck(with_weights: Path, scans: Path, tmp_path: Path) -> None:
    out = tmp_path / "dense"
    invoke("export", with_weights, "--dense-neck", "-o", out, "--scans", scans, "--score", "Cyclist=0.06")
    before, after = load_pillar_bundle(with_weights), load_pillar_bundle(out)
    assert (before.pillar.neck, after.pillar.neck) == ("sparse", "dense")
    assert [each.score_threshold for each in after.spec.classes] == [0.05, 0.02, 0.06], "the bundle's, then the option"
    assert after.provenance.trained_on == "random numbers" and after.provenance.weights_file is None
    assert after.provenance.command == before.provenance.command
    ours, theirs = (Detector(folder)(SCANS[0]).names for folder in (out, with_weights))
    assert [name for name in ours if name != "Cyclist"] == [name for name in theirs if name != "Cyclist"]
    assert len(ours) > 3


def test_a_bundle_written_anew_keeps_its_weights(with_weights: Path, scans: Path, tmp_path: Path) -> None:
    folder = shutil.copytree(with_weights, tmp_path / "bundle")
    post = ("--post", "nms_iou=0.2", "--post", "vote_iou=0.6")
    invoke("export", folder, "-o", folder, "--scans", scans, "--score", "Car=0.1", *post)
    assert load_pillar_bundle(folder).spec.classes[0].score_threshold == 0.1
    invoke("export", folder, "-o", folder, "--scans", scans, "--score", "0.3")
    kept_post = load_pillar_bundle(folder).spec.post
    assert (kept_post.nms_iou, kept_post.vote_iou) == (0.2, 0.6), "the bundle's, not the checkpoint's"
    refused = run_here("export", folder, "-o", folder, "--scans", scans, "--post", "nms=0.2")
    assert refused.returncode > 1 and "--post nms=0.2" in refused.stderr and "nms_iou" in refused.stderr
    assert {each.score_threshold for each in load_pillar_bundle(folder).spec.classes} == {0.3}
    weights, kept = (load_checkpoint(each / WEIGHTS_FILE).detector.state_dict() for each in (with_weights, folder))
    assert weights_sha256(weights) == weights_sha256(kept)


def test_the_same_weights_look_elsewhere(scans: Path, tmp_path: Path) -> None:
    grid = PillarGrid((4.8, 29.76), (-9.6, 9.6), SPEC.grid.z_range_m, v_max_m=0.24, v_y_m=0.24, zones=1)
    spec = dataclasses.replace(SPEC.with_score_threshold(0.02), grid=grid)
    save_checkpoint(tmp_path / "last.ckpt", tiny_checkpoint("none", spec, neck="sparse"))
    tail = ("--scans", scans)
    for name, ranges in (("ahead", ()), ("around", ("--range", "-20.16", "29.76", "-9.6", "9.6"))):
        invoke("export", tmp_path / "last.ckpt", "-o", tmp_path / name, *ranges, *tail)
    ahead, around = (Detector(tmp_path / name) for name in ("ahead", "around"))
    assert around.spec.ranges.x_m == (-20.16, 29.76)
    assert load_pillar_bundle(tmp_path / "around").name == "around", "the folder's"
    points = SCANS[0][SCANS[0][:, 0] >= 4.8]
    narrow, wide = ahead(points).boxes, around(points).boxes
    assert len(narrow) > 3 and _all_in(narrow[narrow[:, 0] > 8], wide) and _all_in(wide[wide[:, 0] > 8], narrow)
    refused = run_here("export", tmp_path / "last.ckpt", "--range", "0", "1.5", "0", "3", "-o", tmp_path / "no", *tail)
    assert refused.returncode > 1 and "x_range_m" in refused.stderr


def _all_in(boxes: NDArray[np.float32], others: NDArray[np.float32]) -> bool:
    return bool((np.abs(boxes[:, None] - others[None]).max(-1).min(1) < 1e-3).all())


def test_what_cannot_be_exported_is_one_line(with_weights: Path, scans: Path, tmp_path: Path) -> None:
    out, tail = tmp_path / "out", ("-o", tmp_path / "out", "--scans", scans)
    for arguments, message in (
        (("fast", *tail), "fast: holds no weights.ckpt"),
        ((tmp_path / "nowhere", *tail), "no such folder"),
        ((with_weights, "--dense-neck", "--int8", "-o", out, "--scans", "/nowhere"), "--dense-neck with --int8"),
        ((with_weights, "--golden", "--dense-neck", "-o", out), "--dense-neck is for a checkpoint"),
        ((with_weights, "--golden", "--trained-on", "foo", "-o", out), "--trained-on is for a checkpoint"),
    ):
        refused = run_here("export", *arguments)
        assert refused.returncode > 1 and message in refused.stderr, refused.stderr
        assert "Traceback" not in refused.stderr and not out.exists()
