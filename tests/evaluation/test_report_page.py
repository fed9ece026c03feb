"""A report on the console."""

import io

from rich.console import Console

from asca_pillars.evaluation.report_page import ReportPage, TextTable


def test_a_narrow_console_cuts_no_figure() -> None:
    table = TextTable("t", ("class", "a long name of a column", "share"), (("Pedestrian", "-226.3", "1.00 - 2.00"),))
    console = Console(record=True, width=20, markup=False, file=io.StringIO())
    ReportPage("title", [table], []).print(console)
    printed = console.export_text()
    assert all(text in printed for text in ("Pedestrian", "-226.3", "1.00 - 2.00", "column")) and "…" not in printed
