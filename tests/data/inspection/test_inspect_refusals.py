"""Data and settings that training could learn nothing from are refused, and what is merely missing is named."""

import json
import re
from collections.abc import Callable
from pathlib import Path

import pytest
import yaml

from asca_pillars.base.errors import DatasetError, OutputError
from asca_pillars.base.schema import to_dict
from asca_pillars.cli.inspect import inspect
from asca_pillars.config.tree import Config, pillar_spec
from asca_pillars.data.inspection.findings import findings
from asca_pillars.data.kitti import KittiSplit
from tests.data.inspection.conftest import FRAMES
from tests.data.inspection.inspected_data import CONFIG, change_files, inspected, with_data, with_grid


def refusal(root: Path, config: Config, tmp_path: Path) -> str:
    """The line that `asca inspect` fails with; the JSON is written anyway."""
    path = tmp_path / "config.yaml"
    path.write_text(yaml.safe_dump(to_dict(config)))
    with pytest.raises(DatasetError) as error:
        inspect(root, config=path, json=tmp_path / "report.json")
    report = json.loads((tmp_path / "report.json").read_text())
    assert report["findings"][0]["level"] == "error" and report["findings"][0]["text"] in str(error.value)
    assert "\n" not in str(error.value)
    return str(error.value)


@pytest.mark.parametrize(
    ("folder", "change", "config", "message"),
    [
        ("label_2", lambda text: re.sub("Cyclist.*\n", "", text), CONFIG, r"no label is of this type \(there are: Car"),
        ("label_2", lambda text: text.replace("Cyclist", "cyclist"), CONFIG, r"spell it 'cyclist'; rename"),
        ("label_2", lambda text: "", CONFIG, r"\(there are: none at all\)"),
        ("label_2", lambda text: text, with_data(min_points=9999), r"data.min_points = 9999; lower it"),
        ("label_2", lambda text: text, with_grid(x_range_m=(40, 60.48)), r"widen model.spec.grid.x_range_m \[40"),
        ("calib", lambda text: text.replace(f"{-0.08:.12e}", "9.0"), CONFIG, r"labels and calib must belong"),
    ],
)
def test_what_training_could_not_learn_from_is_refused(
    data: Path, tmp_path: Path, folder: str, change: Callable[[str], str], config: Config, message: str
) -> None:
    change_files(data, folder, change)
    assert re.search(message, refusal(data, config, tmp_path))


def test_damaged_frames_are_counted_and_refused(data: Path, tmp_path: Path) -> None:
    for frame_id in ("000003", "000004"):
        KittiSplit(data).label_path(frame_id).write_text("Car 0 0\n")
    message = refusal(data, CONFIG, tmp_path)
    assert re.search(r"cannot be read: 2, the first: .*label_2.000003.txt:1: 3 fields", message)
    inspection = inspected(data, CONFIG)
    assert inspection.frames == FRAMES - 2 and not inspection.sampled
    change_files(data, "label_2", lambda text: "Car 0 0\n")
    with pytest.raises(DatasetError, match=r"000000.txt:1: 3 fields"):
        inspected(data, CONFIG)


def test_the_tables_come_before_the_refusal(data: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    change_files(data, "label_2", lambda text: re.sub("Cyclist.*\n", "", text))
    message = refusal(data, CONFIG, tmp_path)
    assert "no anchor is positive for Cyclist in 12 of 12 frames of 'training'" in message
    output = capsys.readouterr().out
    for title in ("Labels", "Objects", "Sizes", "Matching", "Scans"):
        assert title in output
    report = json.loads((tmp_path / "report.json").read_text())
    assert report["types"] == {"Car": 2 * FRAMES, "Pedestrian": FRAMES}
    assert [item["boxes"] for item in report["classes"]] == [2 * FRAMES, FRAMES, 0]


def test_overrides_win_over_the_configuration(data: Path, tmp_path: Path) -> None:
    config = tmp_path / "config.yaml"
    config.write_text(yaml.safe_dump(to_dict(CONFIG)))
    with pytest.raises(DatasetError, match=r"have fewer points than data\.min_points = 100000"):
        inspect(data, config=config, override=["data.min_points=100000"], frames=2)


def test_what_is_missing_in_a_sample_or_beside_it_is_named(data: Path) -> None:
    for frame_id in ("000000", "000006"):
        path = KittiSplit(data).label_path(frame_id)
        path.write_text(re.sub("Cyclist.*\n", "", path.read_text()))
    (first, *_) = findings(inspected(data, CONFIG, frames=2), pillar_spec(CONFIG), CONFIG.data.min_points)
    assert "look at all frames with --frames 12" in first.text
    split = KittiSplit(data)
    split.calib_path("000001").unlink()
    split.label_path("000002").unlink()
    with pytest.raises(DatasetError, match=r"calib.000001.txt: not there \(2 of 24 calibration and label files"):
        inspected(data, CONFIG, frames=1)


def test_json_replaces_its_own_report_alone(data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    config, label = tmp_path / "config.yaml", KittiSplit(data).label_path("000000")
    config.write_text(yaml.safe_dump(to_dict(CONFIG)))
    for _ in range(2):
        inspect(data, config=config, json=tmp_path / "report.json", frames=2)
    (tmp_path / "other.json").write_text(json.dumps({"config": "mine", "findings": []}))
    (tmp_path / "link.json").symlink_to(tmp_path / "report.json")
    work = "asca_pillars.data.inspection.inspect_dataset.inspect_dataset"
    monkeypatch.setattr(work, lambda *_, **__: pytest.fail("told too late"))
    for path in (tmp_path / "other.json", config, label, tmp_path / "link.json", tmp_path):
        before = path.read_bytes() if path.is_file() else b""
        message = r"`asca inspect --json` did not write it|is a link|is a folder; choose the name of a file"
        with pytest.raises(OutputError, match=f"{path.name}: ({message})"):
            inspect(data, config=config, json=path)
        assert before == (path.read_bytes() if path.is_file() else b"")
