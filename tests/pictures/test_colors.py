"""The table of class colors: the same everywhere, and distinguishable for color-blind people."""

import numpy as np
import pytest
from numpy.typing import NDArray

from asca_pillars.pictures.colors import CLASS_COLORS, OTHER_COLORS, class_rgb, class_shares, color_table
from asca_pillars.pictures.visualize import class_color

# Full loss of one kind of cone, in linear RGB (Machado, Oliveira and Fernandes, 2009).
VISION = {
    "normal": np.eye(3),
    "protanopia": np.array(
        [[0.152286, 1.052583, -0.204868], [0.114503, 0.786281, 0.099216], [-0.003882, -0.048116, 1.051998]]
    ),
    "deuteranopia": np.array(
        [[0.367322, 0.860646, -0.227968], [0.280085, 0.672501, 0.047413], [-0.011820, 0.042940, 0.968881]]
    ),
    "tritanopia": np.array(
        [[1.255528, -0.076749, -0.178779], [-0.078411, 0.930809, 0.147602], [0.004733, 0.691367, 0.303900]]
    ),
}
XYZ = np.array(
    [[0.4124564, 0.3575761, 0.1804375], [0.2126729, 0.7151522, 0.0721750], [0.0193339, 0.1191920, 0.9503041]]
)


def lab(colors, vision: NDArray[np.float64]) -> NDArray[np.float64]:
    """CIELAB under D65 of sRGB colors (N, 3), 0..255."""
    shares = np.asarray(colors, dtype=float) / 255
    linear = np.where(shares <= 0.04045, shares / 12.92, ((shares + 0.055) / 1.055) ** 2.4)
    xyz = np.clip(linear @ vision.T, 0, 1) @ XYZ.T / [0.95047, 1, 1.08883]
    f = np.where(xyz > 0.008856, np.cbrt(xyz), 7.787 * xyz + 16 / 116)
    return np.stack([116 * f[:, 1] - 16, 500 * (f[:, 0] - f[:, 1]), 200 * (f[:, 1] - f[:, 2])], axis=1)


def least_difference(colors, vision: NDArray[np.float64]) -> float:
    places = lab(colors, vision)
    differences = np.linalg.norm(places[:, None] - places, axis=-1)
    return float(differences[~np.eye(len(places), dtype=bool)].min())


@pytest.mark.parametrize("vision", VISION.values(), ids=VISION.keys())
def test_colors_are_distinguishable(vision):
    named = list(CLASS_COLORS.values())
    assert least_difference(named, vision) > 38
    assert least_difference([*named, *OTHER_COLORS], vision) > 20
    assert least_difference([*named, (255, 255, 255)], vision) > 34  # ground truth is white
    assert lab(named, vision)[:, 0].min() > 50  # on a dark background


def test_a_class_has_its_color_whatever_else_there_is():
    assert class_rgb("Forklift") == class_rgb("Forklift") in OTHER_COLORS
    assert {class_rgb(f"class {number}") for number in range(50)} == set(OTHER_COLORS)
    assert color_table(["Car", "Van"]) == {"Car": [255, 170, 40], "Van": list(class_rgb("Van"))}


def test_every_form_of_a_color_is_the_same():
    for name in (*CLASS_COLORS, "Van"):
        assert class_color(name) == class_rgb(name)[::-1]
        np.testing.assert_allclose(class_shares(name), np.array(class_rgb(name)) / 255)
