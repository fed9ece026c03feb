"""How many public functions that take or give arrays say the shape, and the unit or the frame of the values.

    python -m benchmarks.docstrings             # the shares, by package
    python -m benchmarks.docstrings --missing   # and every function that says one of the two nowhere

A function counts if its signature names NumPy's or torch's array type, an alias of one, or `HeadMaps`. The shape is in
its docstring as a tuple, such as (N, 4) or (..., 7). A class's docstring counts for its `__init__`; fields of a
NamedTuple or dataclass are not functions. Values without a unit say what they are: an index, a mask, a count, a logit,
a score, a reflectance, a residual, or unitless features.
"""

import ast
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, NamedTuple

import typer

from asca_pillars.commands.run_command import run_command

ROOT = Path(__file__).parent.parent
PACKAGES = ("asca_pillars", "deploy/asca_deploy", "export/asca_export")
_ARRAY = re.compile(r"(np\.|npt\.)?(NDArray|ndarray|HeadMaps)\b")
_SIZE = r"(\.\.\.|(>=)?\w+( [-+*/] \w+)?)"  # of one axis
_SHAPE = re.compile(
    rf"\((?=[^()]*,)(?=\w+,\)|[^()]*(\b(\d|[A-Z]|n[xy]?\b)|\.\.\.)){_SIZE}(, ?{_SIZE})*,?\)|\b[Ss]calars?\b|0-d"
)
_VALUES = re.compile(
    r"\b(met(er|re)s?|m|mm|cm|m²|rad(ian)?s?|degrees?|pixels?|px|ms|seconds?|LiDAR|camera|image|BEV|frames?|IoU|overlaps?"
    r"|[Ii]nd(ex|ices)|[Mm]asks?|counts?|logits?|scores?|probabilit(y|ies)|shares?|[Rr]eflectances?|labels?|bool|features?"
    r"|residuals?|[Uu]nitless|gray|RGB|BGR|colou?rs?|weights?|losses|loss|boxes|points)\b|_(m|rad|px|ms)\b"
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
    paths = [path for package in PACKAGES for path in sorted((root / package).rglob("*.py"))]
    trees = {path: ast.parse(path.read_text(encoding="utf-8")) for path in paths}
    aliases = {name for tree in trees.values() for name in _aliases(tree)}
    for path, tree in trees.items():
        arrays = re.compile(rf"\b({'|'.join(_array_names(tree, aliases))})\b")
        for owner, function in _functions(tree):
            signature = f"{ast.unparse(function.args)} -> {ast.unparse(function.returns) if function.returns else None}"
            if arrays.search(signature):
                text = ast.get_docstring(function) or ""
                if owner is not None and function.name == "__init__":
                    text = ast.get_docstring(owner) or ""
                name = function.name if owner is None else f"{owner.name}.{function.name}"
                values = _VALUES.sub(lambda m: "" if _UNITS.fullmatch(m[0]) else m[0], text)
                place = f"{path.relative_to(root)}:{function.lineno} {name}"
                unit = bool(_VALUES.search(values) or _VALUES.search(_names(function)))
                package = next(package for package in PACKAGES if path.is_relative_to(root / package))
                yield Documented(package, place, bool(_SHAPE.search(text)), unit)


def _aliases(tree: ast.Module) -> Iterator[str]:
    """Names that a module gives to array types."""
    for node in tree.body:
        if isinstance(node, ast.Assign | ast.AnnAssign) and node.value and _is_type(node.value):
            target = node.targets[0] if isinstance(node, ast.Assign) else node.target
            yield ast.unparse(target)


def _is_type(value: ast.expr) -> bool:
    return isinstance(value, ast.Subscript) and bool(_ARRAY.match(ast.unparse(value)))


def _array_names(tree: ast.Module, aliases: set[str]) -> set[str]:
    """Names that stand for an array in a module; a class of its own that is called so does not."""
    names = {"NDArray", "ndarray", r"torch\.Tensor", *_aliases(tree)}
    for node in tree.body:
        if isinstance(node, ast.ImportFrom):
            known = {"Tensor"} if node.module == "torch" else aliases | {"HeadMaps"}
            names |= {one.name for one in node.names} & known
    return names


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
    run_command(main)
