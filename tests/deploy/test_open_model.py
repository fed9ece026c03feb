"""The scores that a detector and a tracker are opened with."""

import pytest

from asca_deploy import find_bundle
from asca_deploy.manifest import load_bundle
from asca_deploy.open_model import track_thresholds
from asca_deploy.tracker import WEAK_SHARE
from asca_pillars.base.errors import ConfigError


def test_tracks_begin_at_the_thresholds_and_go_on_below_the_lowest() -> None:
    own = {one.name: one.score_threshold for one in load_bundle(find_bundle(None)).spec.classes}
    births, least = track_thresholds(None)
    assert births == own and least == pytest.approx(WEAK_SHARE * min(own.values()))
    births, least = track_thresholds(None, {"Car": 0.1})
    assert births == own | {"Car": 0.1} and least == pytest.approx(WEAK_SHARE * 0.1)
    with pytest.raises(ConfigError, match="Tram"):
        track_thresholds(None, {"Tram": 0.5})
