"""`asca eval` into a folder that is not empty: what is replaced, what goes, what stays."""

import shutil
from pathlib import Path
from typing import Any

import pytest

from asca_deploy.evaluate import Protocol
from asca_pillars.base.errors import OutputError
from tests.cli.eval_runs import evaluate, refusal
from tests.helpers.earlier_evaluation import earlier_predictions


def test_predictions_of_somebody_else_are_not_replaced(tmp_path: Path, root: Path, texts: dict[str, Any]) -> None:
    theirs = tmp_path / "out" / "predictions"
    shutil.copytree(texts["predictions"], theirs)
    assert refusal(tmp_path, data=root) == (
        "out: holds predictions and nothing that `asca eval` wrote; choose another folder, or empty it"
    )
    assert len(list(theirs.glob("*.txt"))) == 3
    own = earlier_predictions(tmp_path / "own", texts["predictions"])  # labels may lie where such predictions were
    assert "would replace" in refused(predictions=texts["predictions"], labels=own, out=tmp_path / "own")
    assert len(list(own.iterdir())) == 4
    evaluate(predictions=own, labels=texts["labels"], out=tmp_path / "own")


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


FOREIGN = {
    "report.json": '{"subject": "chemistry", "results": [1, 2, 3]}',
    "report.md": "# Report\n\nMy own.\n",
    "curves.png": "no picture of ours",
    "waymo.json": '{"protocol": "waymo"}',
    "gallery/index.html": "<h1>Photographs</h1>",
}


@pytest.mark.parametrize("earlier", [True, False])
def test_a_file_of_somebody_else_is_not_replaced(tmp_path: Path, texts: dict[str, Any], earlier: bool) -> None:
    out = tmp_path / "out"
    if earlier:  # the folder is ours, the file is not
        evaluate(**texts, out=out)
    kept = contents(out)
    for name, content in FOREIGN.items():
        (out / name).parent.mkdir(parents=True, exist_ok=True)
        (out / name).write_text(content)
        before = contents(out)
        output = refused(**texts, out=out)
        expected = f"{name}: `asca eval` did not write it" if earlier else "nothing that `asca eval` wrote"
        assert expected in output, output
        assert contents(out) == before
        (out / name).unlink()
        if name in kept:
            (out / name).write_bytes(kept[name])


def refused(**arguments: Any) -> str:
    with pytest.raises(OutputError) as caught:
        evaluate(**arguments)
    return str(caught.value)


def contents(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def test_json_replaces_nothing_but_the_report_of_its_protocol(
    tmp_path: Path, root: Path, texts: dict[str, Any]
) -> None:
    evaluate(**texts, out=tmp_path / "first", json_path=tmp_path / "kitti.json")
    evaluate(**texts, out=tmp_path / "first", protocol="waymo", json_path=tmp_path / "waymo.json")
    evaluate(**texts, out=tmp_path / "first", json_path=tmp_path / "kitti.json")
    (tmp_path / "mine.json").write_text(FOREIGN["report.json"])
    (tmp_path / "link.json").symlink_to(tmp_path / "kitti.json")
    prediction = next(texts["predictions"].glob("*.txt"))
    first, out = tmp_path / "first", tmp_path / "out"
    cases: list[tuple[Path, Protocol, str]] = [
        (tmp_path / "mine.json", "kitti", "`asca eval` did not write it"),
        (tmp_path / "waymo.json", "kitti", "`asca eval` did not write it"),
        (tmp_path / "kitti.json", "waymo", "`asca eval` did not write it"),
        (first / "report.json", "waymo", "`asca eval` did not write it"),
        (first / "report.md", "kitti", "`asca eval` did not write it"),
        (out / "report.md", "kitti", "another file of the evaluation has that name"),
        (out / "curves.png", "kitti", "another file of the evaluation has that name"),
        (prediction, "kitti", "`asca eval` did not write it"),
        (root / "ImageSets" / "val.txt", "kitti", "`asca eval` did not write it"),
        (tmp_path / "link.json", "kitti", "is a link"),
    ]
    before = contents(tmp_path)
    for path, protocol, reason in cases:
        assert reason in refused(**texts, out=out, json_path=path, protocol=protocol), path
        assert contents(tmp_path) == before


def test_nothing_is_evaluated_through_links(tmp_path: Path, root: Path, texts: dict[str, Any]) -> None:
    out, elsewhere = tmp_path / "out", tmp_path / "elsewhere"
    earlier_predictions(out, texts["predictions"])
    evaluate(predictions=out / "predictions", data=root, out=out, gallery=None)
    for name in ("report.json", "report.md", "curves.png", "predictions", "gallery"):
        (out / name).rename(elsewhere)
        (out / name).symlink_to(elsewhere)
        before = contents(tmp_path)
        assert f"{name}: is a link" in refused(**texts, out=out)
        assert contents(tmp_path) == before
        (out / name).unlink()
        elsewhere.rename(out / name)
