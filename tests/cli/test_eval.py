"""`asca eval` as a whole: text folders, a bundle and a checkpoint, what is written, and what is refused in one line."""

import json
import os
import shutil
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from numpy.testing import assert_allclose

from asca_deploy import find_bundle
from asca_deploy.manifest import load_pillar_bundle
from asca_pillars.base.errors import AscaError
from asca_pillars.base.installation import install_command
from asca_pillars.evaluation.kitti.average_precision import CLASS_NAMES
from asca_pillars.models.build import Checkpoint, build_model
from asca_pillars.scans.scan_reader import read_scan, write_scan
from tests.cli.eval_runs import evaluate, refusal
from tests.helpers.gallery_cards import cards, title
from tests.helpers.hidden_modules import hiding
from tests.helpers.in_process import invoke
from tests.helpers.saved_checkpoint import save_checkpoint
from tests.helpers.scenes import SPEC
from tests.helpers.tiny_run import CONFIG

BASE_INSTALL = hiding(
    "torch lightning numba sklearn scipy matplotlib pandas",
    """
from pathlib import Path
from asca_pillars.cli.eval import evaluate
evaluate(predictions=Path("det"), labels=Path("gt"), out=Path("out"))
""",
)


def test_two_folders_of_text(tmp_path: Path, texts: dict[str, Any], capsys: pytest.CaptureFixture[str]) -> None:
    report = evaluate(**texts, out=tmp_path / "out", json_path=tmp_path / "deep" / "results.json", gallery=None)
    assert json.loads((tmp_path / "deep" / "results.json").read_text()) == report
    assert {path.name for path in (tmp_path / "out").iterdir()} == {"report.json", "report.md", "curves.png"}
    for name, objects in (("Car", 6), ("Pedestrian", 3), ("Cyclist", 3)):  # all found: the protocol's cap
        for metric in ("bbox", "bev", "3d", "aos"):
            assert_allclose(report["results"][name][metric]["R40"], 100 * (objects - 1) / 40)
    assert report["frames"] == 3 and report["shortage"] is None and report["environment"]["packages"]["numpy"]
    printed = capsys.readouterr().out
    assert f"{texts['predictions']} against {texts['labels']}: 3 frames" in printed
    assert "Car easy: only 6 counted objects; a perfect detector gets at most 12.5 R40, 18.2 R11" in printed


def test_a_missing_prediction_file_is_said_and_scores_count_by_class(
    tmp_path: Path, texts: dict[str, Any], capsys: pytest.CaptureFixture[str]
) -> None:
    (texts["predictions"] / "000001.txt").unlink()
    report = evaluate(**texts, out=tmp_path / "done", score=["Car=0.95"])
    sentence = "evaluated on 2 of 3 frames: no prediction file for 000001; a frame without detections needs"
    assert report["shortage"].startswith(sentence) and report["frames_without_predictions"] == ["000001"]
    assert sentence in capsys.readouterr().out and sentence in (tmp_path / "done" / "report.md").read_text()
    points = [point for point in report["operating_points"] if point["band_m"] is None]
    assert {point["class_name"]: point["score"] for point in points} == {"Car": 0.95, "Pedestrian": 0.3, "Cyclist": 0.3}
    found = {point["class_name"]: point["found"] for point in points}
    assert found["Car"] == 0 < found["Pedestrian"]
    assert "no such class" in refusal(tmp_path, **texts, score=["Lorry=0.5"])


def test_the_base_install_is_enough_for_everything_but_the_curves(tmp_path: Path, texts: dict[str, Any]) -> None:
    shutil.copytree(texts["labels"], tmp_path / "gt")
    command = [sys.executable, "-c", BASE_INSTALL]
    result = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True)
    assert result.returncode == 0 and not result.stderr, result.stderr
    assert f"No curves.png without matplotlib: {install_command('eval')}" in result.stdout.splitlines()
    assert {path.name for path in (tmp_path / "out").iterdir()} == {"report.json", "report.md"}


def test_predictions_with_a_dataset_are_scored_on_its_split_and_drawn(
    tmp_path: Path, root: Path, texts: dict[str, Any]
) -> None:
    (texts["predictions"] / "000002.txt").write_text("")
    report = evaluate(predictions=texts["predictions"], data=root, out=tmp_path / "out", gallery=None, score=["0.95"])
    assert report["frames"] == 2  # of three, because `val` lists two
    names = {path.name for path in (tmp_path / "out" / "gallery").iterdir()}
    assert names == {"001_000001.png", "002_000002.png", "index.html"}  # nothing reaches 0.95: four misses each
    assert {point["score"] for point in report["operating_points"]} == {0.95}
    evaluate(**texts, data=root, out=tmp_path / "out", gallery=None)
    assert {path.name for path in (tmp_path / "out" / "gallery").iterdir()} == {"001_000002.png", "index.html"}


def test_another_detector_is_drawn_beside_the_first(
    tmp_path: Path, root: Path, texts: dict[str, Any], capsys: pytest.CaptureFixture[str]
) -> None:
    found, other, out = texts["predictions"], tmp_path / "other", tmp_path / "out"
    shutil.copytree(found, other)
    compared = {"predictions": found, "data": root, "out": out, "gallery": None, "compare": other}
    evaluate(**compared)
    assert {path.name for path in (out / "gallery").iterdir()} == {"index.html"}, "they are the same"
    # As an evaluation of a model leaves it, whose scores of cars do not reach its own threshold.
    about = {"model": {"name": "newer"}, "scores": {"Car": 0.95, "Pedestrian": 0.3, "Cyclist": 0.3}, "files": []}
    (other / "made_by.json").write_text(json.dumps(about))
    (other / "000001.txt").unlink()
    capsys.readouterr()
    evaluate(**compared)
    assert {path.name for path in (out / "gallery").iterdir()} == {"001_000002.png", "index.html"}
    index = (out / "gallery" / "index.html").read_text()
    assert title(out / "gallery" / "index.html") == f"{found} and newer: where they differ most"
    counts = {f"missed, {found}": 0, f"false, {found}": 0, "missed, newer": 2, "false, newer": 0}
    assert cards(index) == {"000002": {"difference": 2} | counts}
    output = " ".join(capsys.readouterr().out.split())
    assert f"--compare {other}: evaluated on 1 of 2 frames: no prediction file for 000001" in output


def test_a_bundle_and_its_predictions_score_the_same(
    tmp_path: Path, root: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "out"
    for path in (root / "training" / "velodyne").iterdir():
        write_scan(path, read_scan(path).points * np.array([1, 1, 1, 0.1], np.float32))  # darker than any street
    report = evaluate(Path("fast"), data=root, out=out, gallery=1)
    assert "fast on" in report["subject"] and report["frames"] == 2
    assert report["model"]["min_score"] == 0.05 and len(report["model"]["sha256"]["encoder"]) == 64
    own = {spec.name: spec.score_threshold for spec in load_pillar_bundle(find_bundle("fast")).spec.classes}
    assert {point["class_name"]: point["score"] for point in report["operating_points"]} == own
    names = {path.name for path in (out / "predictions").iterdir()}
    assert names == {"000001.txt", "000002.txt", "made_by.json"}
    lines = "".join((out / "predictions" / f"00000{frame}.txt").read_text() for frame in (1, 2)).splitlines()
    assert lines and all(float(line.split()[15]) >= 0.05 for line in lines)
    assert len(list((out / "gallery").glob("*.png"))) == 1
    assert "2 of 2 scans are unlike those that fast was trained on" in capsys.readouterr().out
    assert json.loads((out / "predictions" / "made_by.json").read_text())["scores"] == own
    again = evaluate(predictions=out / "predictions", data=root, out=tmp_path / "again")
    for key in ("results", "bands", "best_scores"):  # text has no thresholds of its own
        assert again[key] == report[key]


def test_a_checkpoint_is_a_model_too(tmp_path: Path, root: Path) -> None:
    torch.manual_seed(0)
    save_checkpoint(tmp_path / "last.ckpt", Checkpoint(CONFIG, build_model(CONFIG.model), 7))
    report = evaluate(tmp_path / "last.ckpt", data=root, out=tmp_path / "out", min_score=0.001, threads=None)
    assert report["model"]["steps"] == 7 and report["model"]["provider"] == "torch cpu"
    names = sorted(path.name for path in (tmp_path / "out" / "predictions").glob("*.txt"))
    assert names == ["000001.txt", "000002.txt"]
    cpus = os.cpu_count() or 1
    for wrong, message in (
        ({"provider": "x"}, "choose cpu, cuda or auto"),
        ({"precision": "reduced"}, "precision reduced does not go with checkpoints"),
        ({"model": tmp_path / "none.ckpt"}, "no such checkpoint"),
        ({"threads": 0}, f"threads 0 must lie between 1 and {4 * cpus}: this machine has {cpus} CPUs"),
    ):
        assert message in refusal(tmp_path / "other", **({"model": tmp_path / "last.ckpt", "data": root} | wrong))


def test_a_model_of_other_classes_alone_is_refused_before_it_runs(tmp_path: Path, root: Path) -> None:
    names = ("Forklift", "Pallet", "Crane")
    classes = tuple(replace(item, name=name) for item, name in zip(SPEC.classes, names, strict=True))
    config = replace(CONFIG, model=replace(CONFIG.model, spec=replace(SPEC, classes=classes)))  # type: ignore[arg-type]
    save_checkpoint(tmp_path / "last.ckpt", Checkpoint(config, build_model(config.model), 7))
    message = refusal(tmp_path, model=tmp_path / "last.ckpt", data=root, threads=None)
    assert "detects Forklift" in message and "give --protocol waymo, which scores any class" in message
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ("", "nothing to evaluate on: give --data ROOT, or --predictions DIR and --labels DIR"),
        ("--predictions {det}", "--predictions det needs --labels DIR, or --data ROOT that has the labels"),
        ("--labels {gt} --data {root}", "goes with --predictions DIR; a model is run on --data ROOT"),
        ("b {texts}", "b and --predictions det: give a model or its predictions, not both"),
        ("{texts} --gallery 3", "--gallery 3 draws scans: give --data ROOT that has them"),
        ("{texts} --compare {det}", "--compare det draws scans: give --data ROOT that has them"),
        ("{texts} --data {root} --compare {det} --gallery 0", "--compare det draws scans: leave --gallery 0 out"),
        (
            "--data {root} --compare {out}/predictions",
            "--compare out/predictions: this evaluation writes there; give it",
        ),
        (
            "{texts} --data {root} --compare {det} --protocol waymo",
            "--compare det belongs to the gallery of --protocol",
        ),
        ("{texts} --score nan", "--score nan must be a number"),
        ("{texts} --json {root}", "kitti: is a folder; choose the name of a file"),
        ("{texts} --json {root} --protocol waymo", "kitti: is a folder; choose the name of a file"),
        (
            "{texts} --protocol waymo --score 0.5",
            "--score 0.5 belongs to --protocol kitti; Waymo's metric goes over all scores: leave it out",
        ),
        ("{texts} --data {root} --protocol waymo --gallery 2", "--gallery 2 belongs to --protocol kitti"),
        ("{texts} --split val", "--split val is a list of the frames of a dataset: give --data ROOT, too"),
        ("--data {root} --score 0.04", "score 0.04 of Car is below --min-score 0.05, the lowest that default is run"),
        ("{root} --data {root}", "bundle.json"),
        ("--data {det}", "velodyne"),
    ],
)
def test_arguments_that_do_not_go_together(
    tmp_path: Path, root: Path, texts: dict[str, Any], options: str, message: str
) -> None:
    det, gt, out = texts["predictions"], texts["labels"], tmp_path / "out"
    given = options.format(det=det, gt=gt, texts=f"--predictions {det} --labels {gt}", root=root, out=out)
    with pytest.raises(AscaError) as caught:
        invoke("eval", *given.split(), "--out", out)
    assert message in str(caught.value).replace(f"{tmp_path}/", "") and "\n" not in str(caught.value)
    assert not out.exists()


def test_a_frame_without_labels_is_named(tmp_path: Path, root: Path, texts: dict[str, Any]) -> None:
    (texts["labels"] / "000002.txt").unlink()
    assert "label_2/000002.txt: cannot read the labels" in refusal(tmp_path, data=root)


def test_a_class_that_kitti_does_not_know_is_left_out_and_named(
    tmp_path: Path, texts: dict[str, Any], capsys: pytest.CaptureFixture[str]
) -> None:
    expected = evaluate(**texts, out=tmp_path / "before")
    capsys.readouterr()
    rename(texts["labels"], "Cyclist", "Forklift")
    report = evaluate(**texts, out=tmp_path / "done")
    assert report["types_left_out"] == ["Forklift"]
    sentence = "Forklift: left out (3 labels, 0 detections), because KITTI's protocol scores Car, Pedestrian, Cyclist"
    assert any(note.startswith(sentence) for note in report["notes"]) and sentence in " ".join(
        capsys.readouterr().out.split()
    )
    for name in ("Car", "Pedestrian"):
        assert report["results"][name] == expected["results"][name]
    rename(texts["predictions"], "Cyclist", "forklift")
    waymo = evaluate(**texts, out=tmp_path / "done", protocol="waymo")
    forklift = next(item for item in waymo["results"] if item["class_name"] == "Forklift" and item["level"] == 2)
    assert forklift["objects"] == 3 and forklift["AP"] == pytest.approx(100)
    for folder in texts.values():
        for name in CLASS_NAMES:
            rename(folder, name, "Forklift")
    message = refusal(tmp_path, **texts)
    assert "neither labels nor predictions are of a class that KITTI's protocol scores" in message
    assert "they have Forklift" in message and message.endswith("give --protocol waymo, which scores any class")


def rename(folder: Path, name: str, other: str) -> None:
    for path in folder.glob("*.txt"):
        path.write_text(path.read_text().replace(f"{name} ", f"{other} "))


def test_waymos_metric_of_labels_against_themselves(
    tmp_path: Path, root: Path, texts: dict[str, Any], capsys: pytest.CaptureFixture[str]
) -> None:
    """With scans at both levels, without them at LEVEL_2; every class and range that has objects gets 100."""
    (texts["predictions"] / "000000.txt").unlink()
    arguments: dict[str, Any] = {"predictions": texts["predictions"], "out": tmp_path / "out", "protocol": "waymo"}
    report = evaluate(**arguments, data=root, json_path=tmp_path / "waymo.json")
    assert json.loads((tmp_path / "waymo.json").read_text()) == report
    assert {path.name for path in (tmp_path / "out").iterdir()} == {"waymo.json", "waymo.md"}
    assert report["frames"] == 2 and {item["class_name"] for item in report["results"]} == set(CLASS_NAMES)
    for item in report["results"]:
        expected = [pytest.approx(100)] * 2 if item["objects"] else [None] * 2
        assert [item["AP"], item["APH"]] == expected
    means = [item["mAP"] for item in report["means"] if item["low_m"] == 0 and item["high_m"] is None]
    assert means == pytest.approx([100, 100])
    assert "LEVEL_1 is not evaluated" not in capsys.readouterr().out
    blind = evaluate(**arguments, labels=texts["labels"])
    assert blind["results"][0]["AP"] is None and blind["results"][4]["AP"] == pytest.approx(100)
    assert blind["frames_without_predictions"] == ["000000"]
    assert "LEVEL_1 is not evaluated" in capsys.readouterr().out


def test_waymos_metric_of_the_shipped_bundle(tmp_path: Path, root: Path) -> None:
    report = evaluate(data=root, out=tmp_path / "out", protocol="waymo")
    assert "default on" in report["subject"] and report["model"]["min_score"] == 0.05
    assert len(list((tmp_path / "out" / "predictions").glob("*.txt"))) == 2
    again = evaluate(predictions=tmp_path / "out" / "predictions", data=root, out=tmp_path / "again", protocol="waymo")
    assert again["results"] == report["results"]
