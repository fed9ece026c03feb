"""How many public functions that take or give arrays say the shape, and the unit or the frame of the values.

    python -m benchmarks.docstrings             # the shares, by package
    python -m benchmarks.docstrings --missing   # and every function that says one of the two nowhere

A class's docstring counts for its `__init__`, a NamedTuple's or dataclass's fields are not functions. Values without a
unit say what they are: an index, a mask, a count, a logit, a score, a reflectance, features of the network.
"""

import ast
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, NamedTuple

import typer

ROOT = Path(__file__).parent.parent
PACKAGES = ("asca_pillars", "deploy/asca_deploy", "export/asca_export")
_ARRAY = re.compile(r"\b(NDArray|ndarray|Tensor|HeadMaps|_Floats|_Integers|_Counts|Points|Maps|Image)\b")
_SHAPE = re.compile(r"\([^()]*\b(\d|[A-Z]\w*|n[xy]?|\.\.\.)[^()]*,[^()]*\)|\bscalars?\b|0-d", re.S)
_VALUES = re.compile(
    r"\b(met(er|re)s?|m|mm|cm|m²|rad(ian)?s?|degrees?|pixels?|px|ms|seconds?|LiDAR|camera|image|BEV|frames?|IoU|overlaps?"
    r"|ind(ex|ices)|masks?|counts?|logits?|scores?|probabilit(y|ies)|shares?|reflectances?|labels?|bool|features?"
    r"|gray|RGB|BGR|colou?rs?|weights?|losses|loss|boxes|points)\b|_(m|rad|px|ms)\b"
)
_UNITS = re.compile(r"\b(boxes|points|labels?|features?|frames?|weights?)\b")  # name the thing, not its unit


class Documented(NamedTuple):
    """One public function with arrays in its signature."""

    package: str
    place: str
    shape: bool
    unit: bool


def documented(root: Path = ROOT) -> Iterator[Documented]:
    """Every public function or method of the packages whose signature names an array type."""
    for package in PACKAGES:
        for path in sorted((root / package).rglob("*.py")):
            if path.name.startswith("_") and path.name != "__init__.py":
                continue
            for owner, function in _functions(ast.parse(path.read_text(encoding="utf-8"))):
                signature = ast.unparse(function.args) + (ast.unparse(function.returns) if function.returns else "")
                if not _ARRAY.search(signature):
                    continue
                text = ast.get_docstring(function) or ""
                if owner is not None and function.name == "__init__":
                    text = ast.get_docstring(owner) or ""
                name = function.name if owner is None else f"{owner.name}.{function.name}"
                values = _VALUES.sub(lambda m: "" if _UNITS.fullmatch(m[0]) else m[0], text)
                place = f"{path.relative_to(root)}:{function.lineno} {name}"
                unit = bool(_VALUES.search(values) or _VALUES.search(_names(function)))
                yield Documented(package, place, bool(_SHAPE.search(text)), unit)


def _names(function: ast.FunctionDef) -> str:
    """Names of the arguments that carry their unit, such as `points_m`."""
    return " ".join(name for one in function.args.args if (name := one.arg).endswith(("_m", "_rad", "_px", "_ms")))


def _functions(tree: ast.Module) -> Iterator[tuple[ast.ClassDef | None, ast.FunctionDef]]:
    for node in tree.body:
        if isinstance(node, ast.FunctionDef) and not node.name.startswith("_"):
            yield None, node
        if isinstance(node, ast.ClassDef) and not node.name.startswith("_"):
            for part in node.body:
                if isinstance(part, ast.FunctionDef) and (not part.name.startswith("_") or part.name == "__init__"):
                    yield node, part


def main(
    missing: Annotated[bool, typer.Option("--missing", help="Name every function that lacks one.")] = False,
) -> None:
    """Print the shares."""
    found = list(documented())
    for package in (*PACKAGES, "all"):
        own = [one for one in found if package in (one.package, "all")]
        shape, unit = (sum(getattr(one, part) for one in own) / len(own) for part in ("shape", "unit"))
        print(f"{package}: {len(own)} functions, shape {shape:.0%}, unit or frame {unit:.0%}")
    for one in found:
        if missing and not (one.shape and one.unit):
            print(f"{one.place}: lacks {'' if one.shape else 'shape '}{'' if one.unit else 'unit'}")


if __name__ == "__main__":
    typer.run(main)
