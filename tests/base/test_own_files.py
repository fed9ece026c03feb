"""A command replaces its own products, recognized by content; never an input, never through a link."""

from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest

from asca_pillars.base.errors import OutputError
from asca_pillars.base.files import write_text
from asca_pillars.base.own_files import (
    Recognizer,
    ending_with,
    is_own_picture,
    json_lines,
    json_object,
    page_end,
    require_no_link,
    require_not_input,
    require_own,
    require_own_file,
    require_replaceable,
    starting_with,
)
from asca_pillars.pictures.visualize import write_png
from tests.helpers.bundle_folder import EXPORT, names, old_bundle

REPORT = json_object("subject", "results", protocol="waymo")
ABOUT = {"simulation.json": json_object("seed")}
PAGE_END = page_end("asca eval")


@pytest.mark.parametrize(
    ("is_own", "own", "foreign"),
    [
        (REPORT, b'{"subject": 1, "results": [], "protocol": "waymo", "more": 2}', b'{"subject": 1, "results": []}'),
        (REPORT, b'{"results": 1, "subject": 1, "protocol": "waymo"}', b'["subject", "results", "waymo"]'),
        (json_object("a"), b'{"a": NaN}', b"\xff\xfe{}"),
        (json_object("a"), b'{"a": 1}\n', b"[" * 5000),
        (json_lines("scan"), b'{"scan": 1}\n{"torn', b'\n{"scan": 1}'),
        (starting_with("# ours\n"), b"# ours\nx: 1\n", b"x: 1\n# ours\n"),
        (ending_with(PAGE_END), f"# Title\n{PAGE_END}".encode(), b"# Title\nby `asca eval`\n"),
        (ending_with(PAGE_END), PAGE_END.encode(), f"{PAGE_END}my note".encode()),
    ],
)
def test_a_file_is_recognized_by_its_content(tmp_path: Path, is_own: Recognizer, own: bytes, foreign: bytes) -> None:
    path = tmp_path / "report"
    require_own_file(path, "asca eval", is_own)
    for harmless in (b"", own):
        path.write_bytes(harmless)
        require_own_file(path, "asca eval", is_own)
    path.write_bytes(foreign)
    with pytest.raises(OutputError, match=r"report: `asca eval` did not write it and would replace it"):
        require_own_file(path, "asca eval", is_own)
    assert path.read_bytes() == foreign


def test_pictures_say_who_drew_them(tmp_path: Path) -> None:
    image = np.random.default_rng(0).integers(0, 256, (40, 30, 3), np.uint8)
    write_png(tmp_path / "ours.png", image)
    cv2.imwrite(str(tmp_path / "theirs.png"), image)
    assert is_own_picture(tmp_path / "ours.png") and not is_own_picture(tmp_path / "theirs.png")
    read = cv2.imread(str(tmp_path / "ours.png"))
    assert read is not None and np.array_equal(read, image), "the file is still whole"


def test_an_input_is_not_replaced(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    bundle = old_bundle(tmp_path / "bundle")
    (tmp_path / "link").symlink_to(bundle)
    require_not_input(tmp_path / "other", (bundle, None, "bundle/a.onnx"))
    require_not_input(bundle / "new.json", (bundle,))  # beside what is read
    for target in (bundle, Path("bundle"), tmp_path / "link", tmp_path):
        with pytest.raises(OutputError, match=r"would replace the input .*a\.onnx"):
            require_not_input(target, (None, tmp_path / "link" / "a.onnx"))
    with pytest.raises(OutputError, match="would replace the input"):
        require_own_file(bundle / "bundle.json", "asca export", json_object("file"), ("link/bundle.json",))


def test_a_folder_to_write_into_is_empty_or_ones_own(tmp_path: Path) -> None:
    for empty in (tmp_path / "absent", tmp_path):
        require_own(empty, "asca simulate", ABOUT)
    (tmp_path / "notes.txt").write_text("mine")
    with pytest.raises(OutputError, match=r"holds notes\.txt and nothing that `asca simulate` wrote"):
        require_own(tmp_path, "asca simulate", ABOUT)
    for foreign in ("", '{"physics": "mine"}'):
        (tmp_path / "simulation.json").write_text(foreign)
        with pytest.raises(OutputError, match="nothing that `asca simulate` wrote"):
            require_own(tmp_path, "asca simulate", ABOUT)
    (tmp_path / "simulation.json").write_text('{"seed": 1}')
    require_own(tmp_path, "asca simulate", ABOUT)
    (tmp_path / "b.json").write_text("mine")
    with pytest.raises(OutputError, match=r"b\.json"):  # another product of one's own does not give it away
        require_own(tmp_path, "asca simulate", ABOUT | {"b.json": json_object("b")})
    (tmp_path / "link").symlink_to(tmp_path / "nowhere")
    for name, message in (("notes.txt", "is a file where a folder"), ("link", "is a broken link")):
        with pytest.raises(OutputError, match=message):
            require_own(tmp_path / name, "asca simulate", ABOUT)


@pytest.mark.parametrize(
    ("link", "target"),
    [
        ("simulation.json", "elsewhere/simulation.json"),
        ("scans/0000", "elsewhere/scans/0000"),
        ("scans", "elsewhere/scans"),  # on the way
        ("scans", "nowhere"),
    ],
)
def test_links_below_the_folder_are_refused(tmp_path: Path, link: str, target: str) -> None:
    out, places = tmp_path / "out", ("scans", "scans/0000")
    for folder in (out, tmp_path / "elsewhere"):
        write_text(folder / "simulation.json", '{"seed": 1}')
        (folder / "scans" / "0000").mkdir(parents=True)
    (tmp_path / "given").symlink_to(out)
    for folder in (out, tmp_path / "given"):  # which may be a link itself
        require_own(folder, "asca simulate", ABOUT, folders=places)
    require_no_link(tmp_path / "given", "scans/0000")
    (out / link).rename(tmp_path / "moved")
    (out / link).symlink_to(tmp_path / target)
    with pytest.raises(OutputError, match="is a link, and nothing is written through links"):
        require_own(tmp_path / "given", "asca simulate", ABOUT, folders=places)
    with pytest.raises(OutputError, match=f"{link}: is a link"):  # named at its step
        require_no_link(out, f"{link}/c")


def _add_a_folder(path: Path) -> None:
    path.unlink(missing_ok=True)
    write_text(path / "notes.txt", "precious")


def _add_a_link(path: Path) -> None:
    path.rename(path.parents[1] / path.name)
    path.symlink_to(path.parents[1] / path.name)


@pytest.mark.parametrize(
    ("name", "spoil"),
    [
        *((name, lambda path: path.write_text("precious")) for name in ("notes.txt", ".hidden", "b.onnx")),
        ("bundle.json", lambda path: path.write_text('{"entries": ["a.onnx"]}')),  # a marker of somebody else
        ("folder", _add_a_folder),
        ("a.onnx", _add_a_folder),
        ("a.onnx", _add_a_link),
    ],
)
def test_an_earlier_output_with_something_foreign_is_not_replaced(
    tmp_path: Path, name: str, spoil: Callable[[Path], object]
) -> None:
    target = old_bundle(tmp_path / "bundle")
    require_replaceable(target, *EXPORT)
    spoil(target / name)
    before = names(target)
    with pytest.raises(OutputError, match=rf"{name}: (`asca export` did not write it|is a link)"):
        require_replaceable(target, *EXPORT)
    assert names(target) == before


def test_a_folder_of_other_files_is_not_replaced(tmp_path: Path) -> None:
    for empty in (tmp_path, tmp_path / "absent"):
        require_replaceable(empty, *EXPORT)
    (tmp_path / "thesis.txt").write_text("precious")
    for target, message in (
        (tmp_path, "thesis.txt and no bundle.json"),
        (tmp_path / "thesis.txt", "is a file where a"),
    ):
        with pytest.raises(OutputError, match=message):
            require_replaceable(target, *EXPORT)
