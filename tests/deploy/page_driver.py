"""Steps of a test that drives the page in a browser."""

import json
import time
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from asca_pillars.pictures.colors import HEIGHT_SPAN_M, height_rgb
from asca_pillars.pictures.visualize import class_color
from tests.deploy.chromium import Tab


def finished(tab: Tab, scan: str) -> Any:
    """What the link `Save boxes` gives, once the page has finished this scan."""
    wait_for(tab, "done")
    saved = json.loads(tab.evaluate("fetch(document.getElementById('save').href).then((file) => file.text())"))
    assert saved["scan"] == scan
    return saved


def move_slider(tab: Tab, name: str, score: float) -> None:
    slider = f"document.querySelector('#scores input[name={name}]')"
    tab.evaluate(f"{slider}.value = {score}; {slider}.dispatchEvent(new Event('input'))")


def failure(tab: Tab) -> str:
    wait_for(tab, "failed")
    return status(tab)


def status(tab: Tab) -> str:
    return str(tab.evaluate("document.getElementById('status').textContent"))


def wait_for(tab: Tab, state: str) -> None:
    time.sleep(0.1)  # a click is on its way
    end = time.monotonic() + 200
    found = None
    while found not in ("done", "failed"):
        assert time.monotonic() < end, "the page does not come to an end"
        found = tab.evaluate("document.body?.dataset.state")
        time.sleep(0.05)
    assert found == state, tab.evaluate("document.getElementById('status').textContent")


def assert_drawn(tab: Tab, path: Path, cars: int) -> None:
    """Points, boxes in the color of cars, and a label for each box."""
    tab.evaluate("new Promise((done) => requestAnimationFrame(() => requestAnimationFrame(done)))")
    tab.screenshot(path)
    picture = cv2.imread(str(path))
    assert picture is not None
    scene = picture[: int(tab.evaluate("document.getElementById('scene').clientHeight"))].astype(int)
    ground, above = height_rgb(np.array([0.0, HEIGHT_SPAN_M]), 0.0)[:, ::-1] * 0.75  # of points that reflect nothing
    for color in (ground, above):
        assert (np.abs(scene - color).max(axis=2) < 14).sum() > 20
    background, car = np.array([26, 20, 15]), np.array(class_color("Car"))  # blue, green, red
    assert (np.abs(scene - background).max(axis=2) > 30).mean() > 0.02
    assert (np.abs(scene - car).max(axis=2) < 12).sum() > 50
    labels = tab.evaluate("document.getElementById('labels').innerText").split("\n")
    assert sum(label.startswith("Car ") for label in labels) == cars
