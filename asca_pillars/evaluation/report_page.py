"""Report of an evaluation for people: the same tables on the console and as Markdown."""

from collections.abc import Sequence
from dataclasses import dataclass

from rich.console import Console
from rich.table import Table


@dataclass(frozen=True)
class TextTable:
    """Table of texts; the first `left` columns are names, the others numbers. Line breaks are for the console."""

    title: str
    columns: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    left: int = 2


@dataclass(frozen=True)
class ReportPage:
    """Title, tables and notes."""

    title: str
    tables: Sequence[TextTable]
    notes: Sequence[str]

    def print(self, console: Console) -> None:
        """Print the page; a name equal to that of the row above is not repeated.

        A table may be wider than the console, so that no number or word is truncated.
        """
        console.print(self.title, style="bold", highlight=False, soft_wrap=True)
        for table in self.tables:
            drawn = Table()
            for index, column in enumerate(table.columns):
                words = (*column.split(), *(row[index] for row in table.rows))
                width = max(map(len, words))
                drawn.add_column(column, justify="left" if index < table.left else "right", min_width=width)
            last = None
            for name, *cells in table.rows:
                if table.left > 1 and last not in (None, name):
                    drawn.add_section()
                drawn.add_row("" if name == last else name, *cells)
                last = name
            console.print(f"\n{table.title}", highlight=False, soft_wrap=True)
            console.print(drawn, crop=False)
        for line in self.notes:
            console.print(line, highlight=False, soft_wrap=True)

    def markdown(self) -> str:
        """Return the page as Markdown."""
        parts = [f"# {self.title}\n"]
        for table in self.tables:
            columns = [column.replace("\n", " ") for column in table.columns]
            parts.append(f"## {table.title}\n\n{markdown_table(columns, table.rows, table.left)}")
        if self.notes:
            parts.append("\n".join([*(f"- {line}" for line in self.notes), ""]))
        return "\n".join(parts)


def markdown_table(columns: Sequence[str], rows: Sequence[Sequence[str]], left: int) -> str:
    """Return a table as Markdown; the first `left` columns are names, the others numbers."""
    ruler = ["---" if index < left else "---:" for index in range(len(columns))]
    return "".join(f"| {' | '.join(cells)} |\n" for cells in (columns, ruler, *rows))
