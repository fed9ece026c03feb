"""Modules that cannot be found, as in an installation without the extras that they come with."""

_HIDE = """
import sys
from importlib.machinery import PathFinder

class Hidden(PathFinder):
    @classmethod
    def find_spec(cls, name, *rest):
        return None if name.split(".")[0] in {names} else super().find_spec(name, *rest)

sys.meta_path = [Hidden if finder is PathFinder else finder for finder in sys.meta_path]
"""


def hiding(names: str, code: str) -> str:
    """A program for `python -c` that finds none of the modules of these names."""
    return _HIDE.replace("{names}", repr(names.split())) + code
