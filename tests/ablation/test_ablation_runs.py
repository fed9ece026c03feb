"""The ablation's runs, real commands on a few made-up frames, resumable and repeatable; and its tables, by hand."""

import dataclasses
import json
import subprocess
import threading
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import yaml

from asca_pillars.ablation import ablation_runs
from asca_pillars.ablation.ablation_runs import Speed, finish_runs, runs, tables
from asca_pillars.ablation.variants import PILLARS, VARIANTS
from asca_pillars.base.errors import AscaError, TrainingError
from asca_pillars.base.own_files import written_by
from asca_pillars.base.schema import to_dict
from asca_pillars.cli import ablate_steps
from asca_pillars.cli.ablate import ablate
from asca_pillars.config.tree import load_config, pillar_spec
from tests.helpers.scenes import write_dataset
from tests.helpers.tiny_run import CONFIG


@pytest.fixture
def config(tmp_path: Path) -> str:
    path = tmp_path / "tiny.yaml"
    one_epoch = dataclasses.replace(CONFIG, train=dataclasses.replace(CONFIG.train, epochs=1))
    path.write_text(yaml.safe_dump(to_dict(one_epoch)))
    return str(path)


@pytest.mark.usefixtures("in_turn")
def test_from_training_to_the_table(tmp_path: Path, config: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """One row as the base, and one with a sparse neck on a pooled map, whose zones any range has."""
    data = write_dataset(tmp_path / "data", 10, val_frames=8)
    out, variants = tmp_path / "out", "baseline,asp_k3_pooled_cpa_channel_fine"
    override = ["train.learning_rate=0.002", "model.spec.grid.x_range_m=[4.8, 20.16]"]
    options: dict[str, Any] = {"override": override, "seeds": "0", "variants": variants}
    ablate(config, data=data, out=out, jobs=2, **options)
    text = (out / "results.md").read_text()
    assert "2 frames for training, 8 for validation" in text and "2 runs" in text
    assert "| K=3 pooled | channel | - | fine | - | - |" in text and "| - | - | - | - | - | - |" in text
    trained = load_config(out / "baseline" / "seed0" / "config.yaml")
    assert (trained.train.learning_rate, pillar_spec(trained).grid.zones) == (2e-3, 1)
    weights = {run.checkpoint: run.checkpoint.stat().st_mtime_ns for run in runs(out, [0], list(VARIANTS.values())[:1])}

    monkeypatch.setattr(ablate_steps, "time_variants", lambda *_: {})  # which is all that is done again
    ablate(config, data=data, out=out, **options)  # nothing is trained twice
    assert all(path.stat().st_mtime_ns == before for path, before in weights.items())
    again = (out / "results.md").read_text()
    assert _accuracies(again) == _accuracies(text)

    with pytest.raises(TrainingError, match="another base configuration or data"):
        ablate(config, data=data, out=out, seeds="0", variants="baseline")


LONG_CARS = (
    "model.spec.classes=[{name: Car, length_m: 4.5, width_m: 1.8, height_m: 1.6, z_m: -1, positive_iou: 0.6, "
    "negative_iou: 0.45}]"
)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"seeds": "0,0"}, "--seeds 0,0: give different whole numbers"),
        ({"seeds": "-1"}, "--seeds -1: give different whole numbers"),
        ({"seeds": "zero"}, "--seeds zero: give different whole numbers"),
        ({"variants": "asp_k9"}, "asp_k9: no such variant"),
        ({"variants": "baseline,baseline"}, "baseline is there twice"),
        ({"override": ["model.spec.grid.x_range_m=[0, 61.0]"]}, "x_range_m"),
        ({"override": [LONG_CARS]}, "--variants cpa_channel_lower_ious: states KITTI's classes"),
        ({}, "3 frames in the list `val`; at least 8 are needed"),
        ({"override": ["data.train_set=none"]}, "ImageSets/none.txt: no such split"),
        ({"override": ["data.val_set=none"]}, "ImageSets/none.txt: no such split"),
    ],
)
def test_what_would_end_an_ablation_ends_it_before_anything_is_trained(
    tmp_path: Path, config: str, options: dict[str, Any], message: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    data = write_dataset(tmp_path / "data", 6, val_frames=3)
    monkeypatch.setattr(ablation_runs, "_run_command", lambda *_: pytest.fail("too late"))
    given = {"seeds": "0", "variants": "baseline,cpa_channel_lower_ious"} | options
    with pytest.raises(AscaError, match=message):
        ablate(config, data=data, out=tmp_path / "out", **given)
    assert not (tmp_path / "out").exists()


def test_as_many_at_a_time_as_asked_for_share_the_cores(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    together = threading.Barrier(2, timeout=60)
    threads = []

    def run(command: list[str], *, env: dict[str, str], **_: object) -> subprocess.CompletedProcess[str]:
        threads.append(int(env["OMP_NUM_THREADS"]))
        together.wait()  # breaks unless two runs are here at once
        return subprocess.CompletedProcess(command, 0)

    monkeypatch.setattr(ablation_runs, "default_threads", lambda: 6)
    monkeypatch.setattr(ablation_runs, "subprocess", SimpleNamespace(run=run, STDOUT=subprocess.STDOUT))
    todo = runs(tmp_path, [0, 1], [VARIANTS["baseline"], VARIANTS["asp_k2"]])
    finish_runs(todo, "tiny.yaml", tmp_path, "val", jobs=2)
    assert threads == [3] * 8 and all(one.trained.exists() for one in todo)


def test_a_run_is_evaluated_before_the_next_is_trained(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    commands = []

    def run(command: list[str], **_: object) -> subprocess.CompletedProcess[str]:
        commands.append(command[3])
        return subprocess.CompletedProcess(command, 0)

    monkeypatch.setattr(ablation_runs, "subprocess", SimpleNamespace(run=run, STDOUT=subprocess.STDOUT))
    todo = runs(tmp_path, [0], [VARIANTS["baseline"], VARIANTS["asp_k2"]])
    todo[1].folder.mkdir(parents=True)
    todo[1].trained.write_text("{}")  # by an ablation that was stopped before its evaluation
    finish_runs(todo, "tiny.yaml", tmp_path, "val", jobs=1)
    assert commands == ["train", "eval", "eval"]
    todo[1].evaluated.parent.mkdir()
    todo[1].evaluated.write_text("{}")
    finish_runs(todo[1:], "tiny.yaml", tmp_path, "val", jobs=1)
    assert len(commands) == 3, "it is finished"
    todo[1].trained.unlink()  # an evaluation of nobody knows what
    finish_runs(todo[1:], "tiny.yaml", tmp_path, "val", jobs=1)
    assert commands[3:] == ["train", "eval"]


def test_the_time_of_a_run_is_that_of_all_its_attempts(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    clock = iter((0.0, 100.0, 500.0, 530.0))
    ends = iter((1, 0, 0))

    def run(command: list[str], **_: object) -> subprocess.CompletedProcess[str]:
        return subprocess.CompletedProcess(command, next(ends))

    monkeypatch.setattr(ablation_runs, "subprocess", SimpleNamespace(run=run, STDOUT=subprocess.STDOUT))
    monkeypatch.setattr(ablation_runs, "time", SimpleNamespace(monotonic=lambda: next(clock)))
    todo = runs(tmp_path, [0], [VARIANTS["baseline"]])
    with pytest.raises(TrainingError):
        finish_runs(todo, "tiny.yaml", tmp_path, "val", jobs=1)
    finish_runs(todo, "tiny.yaml", tmp_path, "val", jobs=1)
    assert json.loads(todo[0].trained.read_text())["seconds"] == 130


def test_a_failed_run_names_its_log(tmp_path: Path) -> None:
    todo = runs(tmp_path / "out", [3, 1], [VARIANTS["rs_aug"], VARIANTS["baseline"]])
    order = [(run.seed, run.variant.name) for run in todo]
    assert order == [(3, "rs_aug"), (3, "baseline"), (1, "rs_aug"), (1, "baseline")]
    todo = runs(tmp_path / "out", [0], [VARIANTS["baseline"]])
    with pytest.raises(TrainingError, match=r"train\.log: `asca train` of baseline, seed 0 failed: .*nowhere"):
        finish_runs(todo, str(tmp_path / "nowhere.yaml"), tmp_path, "val", jobs=1)  # refused before torch is imported
    assert not todo[0].trained.exists()


def _accuracies(text: str) -> list[str]:
    """The tables without parameters, speed and time, which depend on the machine's mood."""
    return [" | ".join(line.split(" | ")[:10]) for line in text.splitlines() if line.startswith("|")]


def test_a_damaged_note_of_the_base_is_one_line_and_can_be_deleted(tmp_path: Path) -> None:
    base = {"config": {"name": "small"}, "data": "data/sim"}
    ablate_steps.require_same_base(tmp_path, base)
    (tmp_path / "none" / "seed0").mkdir(parents=True)
    (tmp_path / "none" / "seed0" / "train.log").write_text(written_by("asca ablate") + "\n")
    note = tmp_path / "ablation.json"
    note.write_text(note.read_text()[:-5])
    with pytest.raises(TrainingError, match=r"ablation\.json: not what `asca ablate` wrote, or damaged .*; delete it"):
        ablate_steps.require_same_base(tmp_path, base)
    note.unlink()
    ablate_steps.require_same_base(tmp_path, base)
    with pytest.raises(TrainingError, match="another base"):
        ablate_steps.require_same_base(tmp_path, base | {"data": "other"})


def _result(car: float, pedestrian: float, cyclist: float | None) -> dict:
    def entry(value: float | None) -> dict | None:
        return None if value is None else {"3d": {"R40": [value + 10, value, value - 1]}}

    results = {"Car": entry(car), "Pedestrian": entry(pedestrian), "Cyclist": entry(cyclist)}
    far = {"Car": entry(6), "Pedestrian": entry(3), "Cyclist": entry(3)}
    bands = [{"low_m": 0.0, "high_m": 40.0, "results": results}, {"low_m": 40.0, "high_m": 80.0, "results": far}]
    return {"results": results, "bands": bands}


def test_means_and_spreads_over_the_seeds() -> None:
    text = tables(PILLARS, {"baseline": [_result(60, 20, 10), _result(64, 26, 12)]}, {})
    row = next(line for line in text.splitlines() if line.startswith("| - | - | - | - | - | - | 62.00"))
    # The mean over classes is 30 and 34, so 32 with half their distance.
    assert row.strip("| ").split(" | ")[6:12] == [
        "62.00 ± 2.00",
        "23.00 ± 3.00",
        "11.00 ± 1.00",
        "32.00 ± 2.00",
        "32.00 ± 2.00",
        "4.00 ± 0.00",
    ]


def test_a_class_that_was_never_detected_counts_as_nothing_found() -> None:
    text = tables(PILLARS, {"rs_aug": [_result(60, 20, None)]}, {"rs_aug": Speed(12.34, 1.05, (1.0, 1.1), 1234567)})
    row = next(line for line in text.splitlines() if "1,234,567" in line)
    assert row.startswith("| - | - | RS-Aug | - | - | - | 60.00 | 20.00 | 0.00 | 26.67 |")
    assert row.endswith("| 1,234,567 | 12.3 | 1.05 (1.00-1.10) |")


def test_easy_moderate_and_hard_stand_in_their_columns() -> None:
    text = tables(PILLARS, {"asp_k3_cpa_channel": [_result(60, 20, 10)]}, {})
    row = next(line for line in text.splitlines() if "70.00 | 60.00 | 59.00" in line)
    assert (
        row
        == "| K=3 | channel | - | - | - | - | 70.00 | 60.00 | 59.00 | 30.00 | 20.00 | 19.00 | 20.00 | 10.00 | 9.00 |"
    )


def test_map_neck_matching_and_scores_are_named() -> None:
    names = ("asp_k3_pooled_cpa_channel_fine", "cpa_channel_lower_ious", "cpa_channel_fine_atss_iou_score")
    text = tables(PILLARS, {name: [_result(60, 20, 10)] for name in names}, {})
    assert "| K=3 pooled | channel | - | fine | - | - | 60.00" in text
    assert "| - | channel | - | - | 0.35 / 0.2 | - | 60.00" in text
    assert "| - | channel | - | fine | atss | iou | 60.00" in text
    text = tables(PILLARS, {"asp_k2": [_result(60, 20, 10)]}, {})
    assert "(K)" in text and "Components" not in text and "Readings" not in text, "tables without results are left out"
