"""The imports of the packages, by their source."""

import ast
import functools
from collections.abc import Iterable, Iterator
from pathlib import Path

ROOT = Path(__file__).parents[2]
PACKAGES = (ROOT / "asca_pillars", ROOT / "deploy" / "asca_deploy", ROOT / "export" / "asca_export")


@functools.cache
def import_statements(path: Path) -> list[tuple[ast.stmt, bool]]:
    """Imports of a file, within functions as well, each with whether it is for types alone."""
    found: list[tuple[ast.stmt, bool]] = []

    def visit(block: Iterable[ast.AST], for_types: bool) -> None:
        for node in block:  # statements alone: most of a tree is expressions
            if isinstance(node, ast.Import | ast.ImportFrom):
                found.append((node, for_types))
            typing = isinstance(node, ast.If) and ast.unparse(node.test) == "TYPE_CHECKING"
            visit(getattr(node, "body", ()), for_types or typing)
            for part in ("orelse", "handlers", "finalbody", "cases"):
                visit(getattr(node, part, ()), for_types)

    visit(ast.parse(path.read_text(encoding="utf-8")).body, False)
    return found


def imports(path: Path) -> Iterator[str]:
    for node, _ in import_statements(path):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: imports are absolute"
            yield from (f"{node.module}.{alias.name}" for alias in node.names)
