"""What a gallery's page holds, read from its HTML."""

import json
import re
from html import unescape
from pathlib import Path
from typing import Any


def cards(page: str) -> dict[str, dict[str, Any]]:
    """The values of each picture by its title."""
    found = re.findall(r'data-values="([^"]*)".*?<h2>(.*?)</h2>', page, re.DOTALL)
    return {unescape(title): json.loads(unescape(values)) for values, title in found}


def sources(page: str) -> list[str]:
    """The addresses of all pictures, links, scripts and styles but those that are in the page itself."""
    found = re.findall(r'(?:src|href)="([^"]*)"', page)
    return [unescape(source) for source in found if not source.startswith("data:")]


def title(path: Path) -> str:
    """The title of a page."""
    found = re.search(r"<title>(.*?)</title>", path.read_text(encoding="utf-8"), re.DOTALL)
    assert found is not None
    return unescape(found[1])
