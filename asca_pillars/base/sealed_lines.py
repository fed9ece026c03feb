"""Lines of JSON with a digest each: one that is damaged, cut or from another place is told from a whole one.

    ["0123456789abcdef", {"scan": "a.bin", "boxes": []}]

The digest is of the text behind it and of a key, which names the file and the place that the line belongs to.
"""

import hashlib

_DIGITS = 16
_BEFORE = len('["", ') + _DIGITS


def sealed(text: str, key: str) -> str:
    """Return the line of a JSON text that has no line break, with its end."""
    return f'["{_digest(text, key)}", {text}]\n'


def unsealed(line: bytes, key: str) -> str | None:
    """Return the JSON text of a line that `sealed` made with the same key; None for anything else."""
    try:
        text = line[_BEFORE:-2].decode()
    except UnicodeDecodeError:
        return None
    return text if line == sealed(text, key).encode() else None


def _digest(text: str, key: str) -> str:
    return hashlib.sha256(f"{key}\n{text}".encode()).hexdigest()[:_DIGITS]
