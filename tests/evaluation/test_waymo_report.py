"""The table, notes and JSON of Waymo's metric."""

import json
from math import inf

from asca_pillars.evaluation.kitti.objects import frame_objects
from asca_pillars.evaluation.predictions import ScoredFrames
from asca_pillars.evaluation.waymo import (
    LEVELS,
    RANGES_M,
    WaymoReport,
    WaymoScore,
    waymo_json,
    waymo_notes,
    waymo_table,
)

EMPTY = frame_objects("0", [])


def report(has_points: bool = True) -> WaymoReport:
    """AP 60 and 50 of cars and forklifts, everywhere and within 30 m alone."""
    scores = [
        WaymoScore(name, level, span, 3, ap, ap - 10) if span[0] == 0 else WaymoScore(name, level, span, 0, None, None)
        for name, ap in (("Car", 60.0), ("Forklift", 50.0))
        for level in LEVELS
        for span in RANGES_M
    ]
    return WaymoReport("made up", ScoredFrames((EMPTY,), (EMPTY,), ()), scores, has_points, {"model": "none"})


def test_the_table_has_both_levels_all_ranges_and_a_note_on_missing_points() -> None:
    table = waymo_table(report())
    assert [row[:2] for row in table.rows[:4]] == [("Car", text) for text in ("all", "0-30 m", "30-50 m", "50+ m")]
    assert table.rows[0][2:] == ("60.00", "50.00", "3") * 2
    assert table.rows[2][2:] == ("-", "-", "0") * 2
    assert table.rows[8][2:] == ("55.00", "45.00", "") * 2 and table.rows[10][2:] == ("-", "-", "") * 2
    assert len(table.rows) == 12 and {len(row) for row in table.rows} == {len(table.columns)}
    assert waymo_notes(report()) == []
    assert "give --data ROOT with the scans" in waymo_notes(report(has_points=False))[0]


def test_the_json_knows_no_infinity() -> None:
    content = json.loads(json.dumps(waymo_json(report()), allow_nan=False))
    assert len(content["results"]) == 16 and content["protocol"] == "waymo" and content["model"] == "none"
    first, last = content["results"][0], content["results"][3]
    assert first == {"class_name": "Car", "level": 1, "low_m": 0, "high_m": None, "objects": 3, "AP": 60, "APH": 50}
    assert (last["low_m"], last["high_m"], last["AP"]) == (50, None, None)
    assert content["means"][0] == {"level": 1, "low_m": 0, "high_m": None, "mAP": 55, "mAPH": 45}
    assert content["means"][2]["mAP"] is None and RANGES_M[0] == (0, inf)
