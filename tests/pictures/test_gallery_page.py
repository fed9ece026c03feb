"""A page of pictures: complete, escaped, without addresses outside its folder, and sorted by its script."""

import json
import re
import shutil
import subprocess
from html.parser import HTMLParser
from pathlib import PurePath

import pytest

from asca_pillars.pictures.colors import class_rgb
from asca_pillars.pictures.gallery_page import GalleryCard, gallery_page
from tests.helpers.gallery_cards import cards, sources

EVIL = "\"><script>alert(1)</script>&amp; ' </title>"
CARDS = [
    GalleryCard("a", PurePath("a.png"), {"missed": 2, "score": 0.5}, {"Car": 3, "Van": 0}),
    GalleryCard("b/ä b", PurePath("b/ä b#?.png"), {"missed": 10}, remarks=["odd & cut"]),
    GalleryCard(EVIL, PurePath("c.png"), {"score": float("nan"), EVIL: 1}, {EVIL: 1}, [EVIL]),
]


class Tags(HTMLParser):
    def __init__(self) -> None:
        super().__init__()
        self.tags: list[str] = []
        self.open: list[str] = []

    def handle_starttag(self, tag, attrs):
        self.tags.append(tag)
        if tag not in ("meta", "link", "img", "input"):
            self.open.append(tag)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag


def test_a_page_holds_its_pictures_and_values():
    page = gallery_page("Scans", "One.\n\nTwo & three.", CARDS[:2], "missed", end="\n<!-- end -->\n")
    assert cards(page) == {"a": {"missed": 2, "score": 0.5}, "b/ä b": {"missed": 10}}
    assert sources(page) == ["a.png", "a.png", *["b/%C3%A4%20b%23%3F.png"] * 2]
    assert "<p>One.</p><p>Two &amp; three.</p>" in page and page.endswith("\n<!-- end -->\n")
    red, green, blue = class_rgb("Car")
    assert f"rgb({red} {green} {blue})" in page and "Car 3" in page and "Van" not in page
    assert "http:" not in page and "https:" not in page


def test_names_from_data_never_become_html():
    page = gallery_page(EVIL, EVIL, CARDS, EVIL)
    tags = Tags()
    tags.feed(page)
    assert not tags.open
    assert tags.tags.count("script") == 1 and tags.tags.count("figure") == 3
    assert cards(page)[EVIL] == {EVIL: 1}  # a number that is none is left out


def test_no_pictures_are_still_a_page():
    assert "There is nothing to show." in gallery_page("Scans", "", [], None)


@pytest.mark.skipif(shutil.which("node") is None, reason="needs node")
@pytest.mark.parametrize(
    ("clicks", "expected"),
    [([], "bca"), (["score"], "bca"), (["score", "score"], "acb"), (["missed"], "acb"), (["order"], "acb")],
)
def test_the_script_sorts(clicks, expected):
    """Largest first, and the other way round after a second click; what has no such value comes last."""
    values = {"a": {"score": 0.1, "missed": 3}, "b": {"score": 0.9}, "c": {"score": 0.5, "missed": 2}}
    made = [GalleryCard(name, PurePath(f"{name}.png"), values[name]) for name in ("b", "c", "a")]
    page = gallery_page("Scans", "", made, None)
    script = re.search(r"<script>(.*)</script>", page, re.DOTALL)
    assert script is not None
    # A stand-in for the document, of what the script asks for.
    stand_in = """
    const made = FIGURES.map(([name, values], order) => {
      return { name, dataset: { order, values: JSON.stringify(values) } };
    });
    let shown = made;
    const listeners = {};
    const other = { addEventListener() {}, querySelector: () => other };
    const document = {
      querySelectorAll: () => [],
      querySelector: (selector) => ({
        main: { querySelectorAll: () => made, append: (...sorted) => { shown = sorted; }, addEventListener() {} },
        nav: { addEventListener: (kind, listener) => { listeners[kind] = listener; } },
      }[selector] ?? other),
    };
    """.replace("FIGURES", json.dumps([[card.title, card.values] for card in made]))
    presses = "".join(f"listeners.click({{ target: {{ dataset: {{ key: {json.dumps(key)} }} }} }});" for key in clicks)
    program = f"{stand_in}{script[1]}{presses}console.log(shown.map(({{ name }}) => name).join(''));"
    run = subprocess.run(["node", "-e", program], capture_output=True, text=True, timeout=60)
    assert run.returncode == 0, run.stderr
    assert run.stdout.strip() == expected
