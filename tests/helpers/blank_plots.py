"""Plots without anything on them."""

import pytest


def blank_plots(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let matplotlib write its files without drawing, which takes a second for each."""
    monkeypatch.setattr("matplotlib.figure.Figure.draw", lambda figure, renderer: None)
