"""`asca eval` into a folder that is not empty: what is replaced, what goes, what stays."""

import shutil
from pathlib import Path
from typing import Any

import pytest

from asca_pillars.commands.eval_steps import Protocol
from tests.commands.test_eval import evaluate, refusal
from tests.earlier_evaluation import earlier_predictions


def test_predictions_of_somebody_else_are_not_replaced(tmp_path: Path, root: Path, texts: dict[str, Any]) -> None:
    theirs = tmp_path / "out" / "predictions"
    shutil.copytree(texts["predictions"], theirs)
    assert refusal(tmp_path, data=root) == (
        "out: holds predictions and nothing that `asca eval` wrote; choose another folder, or empty it"
    )
    assert len(list(theirs.glob("*.txt"))) == 3


@pytest.mark.parametrize("protocol", ["kitti", "waymo"])
def test_pictures_and_predictions_of_another_evaluation_do_not_stay_beside_a_new_report(
    tmp_path: Path, root: Path, texts: dict[str, Any], protocol: Protocol
) -> None:
    out = tmp_path / "out"
    evaluate(**texts, out=out)
    (out / "notes.txt").write_text("my own")
    (texts["predictions"] / "000002.txt").write_text("")
    own = earlier_predictions(out, texts["predictions"])
    evaluate(predictions=own, data=root, out=out, gallery=None)
    assert len(list(own.iterdir())) == 4, "what is scored stays"
    assert len(list((out / "gallery").glob("*.png"))) == 1
    evaluate(**texts, out=out, protocol=protocol)
    kittis, waymos = {"report.json", "report.md", "curves.png"}, {"waymo.json", "waymo.md"}
    # The pictures belong to the report of KITTI's protocol, as the curves do.
    left = kittis if protocol == "kitti" else kittis | waymos | {"gallery"}
    assert {path.name for path in out.iterdir()} == left | {"notes.txt"}
