"""The ablation's tables against numbers that can be worked out by hand."""

from asca_pillars.ablation.ablation_table import Speed, tables
from asca_pillars.ablation.variants import PILLARS


def _result(car: float, pedestrian: float, cyclist: float | None) -> dict:
    def entry(value: float | None) -> dict | None:
        return None if value is None else {"3d": {"R40": [value + 10, value, value - 1]}}

    results = {"Car": entry(car), "Pedestrian": entry(pedestrian), "Cyclist": entry(cyclist)}
    far = {"Car": entry(6), "Pedestrian": entry(3), "Cyclist": entry(3)}
    bands = [{"low_m": 0.0, "high_m": 40.0, "results": results}, {"low_m": 40.0, "high_m": 80.0, "results": far}]
    return {"results": results, "bands": bands}


def test_means_and_spreads_over_the_seeds() -> None:
    text = tables(PILLARS, {"baseline": [_result(60, 20, 10), _result(64, 26, 12)]}, {})
    row = next(line for line in text.splitlines() if line.startswith("| - | - | - | - | - | - | 62.00"))
    # The mean over classes is 30 and 34, so 32 with half their distance.
    assert row.strip("| ").split(" | ")[6:12] == [
        "62.00 ± 2.00",
        "23.00 ± 3.00",
        "11.00 ± 1.00",
        "32.00 ± 2.00",
        "32.00 ± 2.00",
        "4.00 ± 0.00",
    ]


def test_a_class_that_was_never_detected_counts_as_nothing_found() -> None:
    text = tables(PILLARS, {"rs_aug": [_result(60, 20, None)]}, {"rs_aug": Speed(12.34, 1.05, (1.0, 1.1), 1234567)})
    row = next(line for line in text.splitlines() if "1,234,567" in line)
    assert row.startswith("| - | - | RS-Aug | - | - | - | 60.00 | 20.00 | 0.00 | 26.67 |")
    assert row.endswith("| 1,234,567 | 12.3 | 1.05 (1.00-1.10) |")


def test_easy_moderate_and_hard_stand_in_their_columns() -> None:
    text = tables(PILLARS, {"asp_k3_cpa_channel": [_result(60, 20, 10)]}, {})
    row = next(line for line in text.splitlines() if "70.00 | 60.00 | 59.00" in line)
    assert (
        row
        == "| K=3 | channel | - | - | - | - | 70.00 | 60.00 | 59.00 | 30.00 | 20.00 | 19.00 | 20.00 | 10.00 | 9.00 |"
    )


def test_map_neck_matching_and_scores_are_named() -> None:
    names = ("asp_k3_pooled_cpa_channel_fine", "cpa_channel_lower_ious", "cpa_channel_fine_atss_iou_score")
    text = tables(PILLARS, {name: [_result(60, 20, 10)] for name in names}, {})
    assert "| K=3 pooled | channel | - | fine | - | - | 60.00" in text
    assert "| - | channel | - | - | 0.35 / 0.2 | - | 60.00" in text
    assert "| - | channel | - | fine | atss | iou | 60.00" in text


def test_only_tables_with_results_are_written() -> None:
    text = tables(PILLARS, {"asp_k2": [_result(60, 20, 10)]}, {})
    assert "(K)" in text and "Components" not in text and "Readings" not in text
