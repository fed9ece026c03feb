"""Imports of one's own CSV and JSON keep what the labels say beside the boxes."""

import json
from pathlib import Path

from asca_pillars.data.boxes.box_split import BoxSplit
from tests.data.boxes.box_scenes import write_box_dataset
from tests.helpers.in_process import invoke


def test_time_stamps_stay(tmp_path: Path) -> None:
    own = write_box_dataset(tmp_path / "own", 3)
    lines = [{"scan": f"{number:06d}.bin", "time_s": number / 10, "boxes": []} for number in range(2)]
    lines.append({"scan": "000002.bin", "boxes": []})
    (tmp_path / "boxes.jsonl").write_text("".join(f"{json.dumps(line)}\n" for line in lines))
    invoke("import", tmp_path / "boxes.jsonl", tmp_path / "out", "--scans", own / "scans")
    assert BoxSplit(tmp_path / "out").times_s == {"000000": 0.0, "000001": 0.1}


def test_hidden_labels_are_none(tmp_path: Path) -> None:
    """As macOS leaves them on a disk that it did not format."""
    own = write_box_dataset(tmp_path / "own", 1)
    labels = tmp_path / "labels"
    labels.mkdir()
    (labels / "000000.json").write_text('{"boxes": []}')
    (labels / "._000000.json").write_bytes(b"\0")
    invoke("import", labels, tmp_path / "out", "--scans", own / "scans")
    assert BoxSplit(tmp_path / "out").frame_ids == ("000000",)
