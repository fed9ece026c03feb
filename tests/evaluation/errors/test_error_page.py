"""The page: whole, without a network, with what one has to see in its pictures."""

import re
from html.parser import HTMLParser
from xml.etree import ElementTree

import numpy as np

from asca_pillars.data.insertion.ground_fit import fit_ground
from asca_pillars.evaluation.errors.error_report import error_page
from asca_pillars.evaluation.errors.error_summary import match_frames
from asca_pillars.evaluation.errors.worst_cases import BOX_CASES, DrawnBox, crop_svg, draw_cases, worst_cases
from asca_pillars.evaluation.report_page import TextTable
from tests.evaluation.errors.made_frames import GROUND_Z_M, MadeFrames, column, frame, ground

PERSON = np.array([15.0, 0.0, GROUND_Z_M + 0.9, 0.8, 0.6, 1.8, 0.0])
CAR = np.array([20.0, 4.0, GROUND_Z_M + 0.75, 4.0, 1.6, 1.5, 0.0])
VOID = {"meta", "rect", "path", "polygon", "br", "hr", "link", "img", "input"}


class Checked(HTMLParser):
    """Every element that is opened is closed, in order."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.open: list[str] = []
        self.attributes: list[tuple[str, str | None]] = []
        self.feed(text)
        self.close()
        assert self.open == []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.attributes += attrs
        if tag not in VOID:
            self.open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        if tag not in VOID:
            assert self.open.pop() == tag


def panes(svg: str) -> list[ElementTree.Element]:
    return list(ElementTree.fromstring(svg))


def dots(pane: ElementTree.Element, style: str) -> np.ndarray:
    found = pane.find(f"path[@class='{style}']")
    pairs = [] if found is None else re.findall(r"M(-?\d+) (-?\d+)h0", found.get("d") or "")
    return np.array(pairs, int).reshape(-1, 2)


def test_a_post_from_every_side_and_other_boxes_from_above() -> None:
    """A bright post to the left of the middle of the box, as the sensor sees it, and a dark one behind it."""
    points = np.concatenate([ground(), column(15, 0.2, 2.0, reflectance=0.9), column(16.5, 0, 1.0)])
    above, side, sensor = panes(crop_svg(points, fit_ground(points), [DrawnBox(PERSON, "detection", main=True)]))
    reach_cm = 250
    post = dots(above, "bright").mean(axis=0)
    np.testing.assert_allclose(post, (reach_cm - 20, reach_cm), atol=3)
    assert dots(above, "near").size == 0
    behind = dots(above, "far").mean(axis=0)
    np.testing.assert_allclose(behind, (reach_cm, reach_cm - 150), atol=3)
    assert dots(side, "bright")[:, 0].mean() == np.clip(dots(side, "bright")[:, 0].mean(), 247, 253)
    assert dots(side, "near")[:, 0].mean() > reach_cm + 140, "what is within its width is strong"
    assert abs(dots(sensor, "bright")[:, 0].mean() - (reach_cm - 20)) < 3
    assert dots(sensor, "near").size == 0, "what is behind is pale"
    heights = 330 - dots(sensor, "bright")[:, 1]
    assert heights.max() in range(188, 200) and heights.min() in range(10, 25)
    assert [one.get("class") for one in sensor.iter("polygon")] == ["detection"]
    boxes = [DrawnBox(PERSON, "label", main=True), DrawnBox(np.add(PERSON, [1, 1, 0, 0, 0, 0, 0]), "detection")]
    above, *upright = panes(crop_svg(ground(), None, boxes))
    assert [one.get("class") for one in above.iter("polygon")] == ["label", "detection other"] * 2
    assert all([one.get("class") for one in pane.iter("polygon")] == ["label"] for pane in upright)


def made() -> MadeFrames:
    frames = {}
    for number in range(40):
        far = np.add(CAR, [number / 100, 0, 0, number / 50, 0, 0, np.pi * (number == 7)])
        found = [("Car", 0.5 + number / 100, far), ("Car", 0.4 + number / 100, np.add(CAR, [0, -9, 0, 0, 0, 0, 0]))]
        objects = [("Car", CAR), ("Car", np.add(CAR, [9, 0, 0, 0, 0, 0, 0]))]
        frames[f"<{number:02d}>"] = frame(objects, found, frame_id=f"<{number:02d}>")
    return MadeFrames(frames)


def test_the_page_has_the_worst_cases_is_whole_and_needs_no_network() -> None:
    frames = made()
    matches = match_frames(frames, {"Car": 0.3})
    worst = {section.title: section.cases for section in worst_cases(matches)}
    assert [case.frame for case in worst["False detections, highest score first"]] == [39, 29, 19, 9]
    assert [case.frame for case in worst["Far end, largest error first"]] == [39, 29, 19, 9]
    assert [case.frame for case in worst["Heading turned round, highest score first"]] == [7]
    assert len(worst["Missed objects, most points first"]) == 4
    assert max(map(len, worst.values())) <= 4 <= BOX_CASES
    sections = draw_cases(frames, matches, worst_cases(matches))
    table = TextTable("A & B", ("class", "data<set>", "n"), (("Car", "<real>", "1"), ("Car", "x", "2")))
    page = error_page("<model> on data", [table], [table], ["a < b"], sections)
    checked = Checked(page)
    assert "<real>" not in page and "&lt;real&gt;" in page and "<39>" not in page and "&lt;39&gt;" in page
    assert not {name for name, _ in checked.attributes} & {"src", "action", "onclick"}
    assert {value for name, value in checked.attributes if name == "href"} == {"#class-Car"}
    assert "url(" not in page and "import" not in page and "fetch" not in page
    policy = "default-src 'none'; style-src 'unsafe-inline'; script-src 'unsafe-inline'"
    assert ("content", policy) in checked.attributes
    assert page.count("<figure") == sum(len(section.cases) for section in sections)
    for svg in re.findall(r"<figure[^>]*>(<svg.*?)<figcaption>", page):
        assert len(panes(svg)) == 3
