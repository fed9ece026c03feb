"""numba's cache: used where it is whole, made anew where it is damaged, done without where it cannot be written."""

import errno
import logging
import os
import sys
from collections.abc import Callable
from importlib.util import module_from_spec, spec_from_file_location
from pathlib import Path
from typing import Any

import numba
import pytest

from asca_pillars.base import compiling

KERNELS = """
from numba import types

from asca_pillars.base.compiling import cached, compiled


@compiled(types.int64)
def double(number):
    return 2 * number


@cached(error_model="numpy")
def triple(number):
    return 3 * number
"""


@pytest.fixture
def source(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setattr(numba.config, "CACHE_DIR", str(tmp_path / "cache"))
    monkeypatch.setattr(compiling._CheckedCache, "warned", False)
    path = tmp_path / "made_up_kernels.py"
    path.write_text(KERNELS)
    return path


def imported(source: Path, before: Callable[[Any], object] = lambda module: None) -> Any:
    """The module, as a process of its own would import it; `before` that gets it still empty."""
    spec = spec_from_file_location("made_up_kernels", source)
    assert spec is not None and spec.loader is not None
    module = module_from_spec(spec)
    before(module)
    spec.loader.exec_module(module)
    return module


def hits(source: Path) -> list[bool]:
    """Return for both kinds of functions whether a process that imports and calls them takes them from the cache."""
    module = imported(source)
    assert (module.double(21), module.triple(14)) == (42, 42)
    return [bool(function.stats.cache_hits) for function in (module.double, module.triple)]


@pytest.mark.parametrize("suffix", [".nbi", ".nbc"])
@pytest.mark.parametrize(
    "damage",
    [
        lambda content: b"",
        lambda content: content[:-32],  # as numba itself writes them
        lambda content: content[:-40] + bytes([content[-40] ^ 0x10]) + content[-39:],
        lambda content: b"cos\nsystem\n(S'false'\ntR.",
    ],
)
def test_a_damaged_cache_is_made_anew(source: Path, suffix: str, damage: Callable[[bytes], bytes]) -> None:
    hits(source)
    assert hits(source) == [True, True]
    files = [path for path in (source.parent / "cache").rglob("*") if path.suffix == suffix]
    assert len(files) == 2
    for path in files:
        path.write_bytes(damage(path.read_bytes()))
    assert hits(source) == [False, False]
    assert hits(source) == [True, True]


def test_where_nothing_can_be_written_it_is_named_and_ends_nothing(
    source: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    def fail(*_: Any) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    with monkeypatch.context() as full, caplog.at_level(logging.WARNING):
        full.setattr(os, "replace", fail)
        assert hits(source) == [False, False]
    (record,) = caplog.records
    for words in ("cache", "No space left on device", "set NUMBA_CACHE_DIR to another folder"):
        assert words in record.getMessage()
    assert hits(source) == [False, False]
    assert hits(source) == [True, True]
    for path in [path for path in (source.parent / "cache").rglob("*") if path.is_file()]:
        path.unlink()
        path.mkdir()
    assert hits(source) == [False, False], "with a folder in the place of a file"

    def nowhere(_: Any) -> None:
        raise RuntimeError("cannot cache function: no locator available")

    monkeypatch.setattr(compiling, "_CheckedCache", nowhere)
    assert compiling.compiled(numba.types.int64)(lambda number: 2 * number)(21) == 42


def test_a_cache_for_a_class_that_is_gone_is_made_anew(source: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """As after an update that gave the class of an argument another name: numba's index holds the old one."""
    text = """
from typing import NamedTuple
from asca_pillars.base.compiling import cached

class Earlier(NamedTuple):
    value: int

Pair = Earlier

@cached()
def value_of(pair):
    return pair.value
"""
    for written in (text, text.replace("Earlier", "Renamed")):
        source.write_text(written)
        module = imported(source, lambda made: monkeypatch.setitem(sys.modules, "made_up_kernels", made))
        assert module.value_of(module.Pair(3)) == 3
