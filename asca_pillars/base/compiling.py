"""Compilation with numba of the loops in `*_kernels.py` and in the simulator.

The compiled functions of kernels take memory made by NumPy and have their signatures written out: that takes a quarter
off the time to compile, and all of it is spent when they are imported, once per machine (numba's cache keeps the
result). `nogil` lets other threads run meanwhile; nothing is `parallel`, because the network uses the cores.

numba loads what lies in its cache as it is, machine code as well: an empty file ends the process with an EOFError, a
flipped bit with SIGABRT. Here each file of the cache carries a digest. One that is damaged is compiled anew.
"""

import contextlib
import hashlib
import io
import logging
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numba
from numba import types
from numba.core.caching import FunctionCache, IndexDataCacheFile

# NumPy's division, which does not look out for zeros; no entry for C programs.
_PLAIN = {"error_model": "numpy", "no_cfunc_wrapper": True}
_DIGEST_BYTES = 32
_log = logging.getLogger(__name__)

inner = numba.njit(no_cpython_wrapper=True, **_PLAIN)
"""Decorator of functions that only compiled functions of the same file call."""


def compiled(*arguments: Any, **options: Any) -> Callable[[Callable[..., Any]], Callable[..., Any]]:
    """Return a decorator that compiles for arguments of these types at import, cached as by `cached`.

    `options` are those of `numba.njit`.
    """

    def decorate(function: Callable[..., Any]) -> Callable[..., Any]:
        kept = cached(nogil=True, **_PLAIN, **options)(function)
        if kept is not function:
            kept.compile(arguments)  # type: ignore[attr-defined]  # a numba dispatcher
            kept.disable_compile()  # type: ignore[attr-defined]
        return kept

    return decorate


def cached(**options: Any) -> Callable[[Callable[..., Any]], Callable[..., Any]]:
    """Return the decorator `numba.njit` with these options, cached where a folder can be written.

    Where there is none, each process compiles for itself, some seconds, and is then as fast as others.
    """

    def decorate(function: Callable[..., Any]) -> Callable[..., Any]:
        dispatcher = numba.njit(**options)(function)
        if dispatcher is not function:  # as it is with NUMBA_DISABLE_JIT
            with contextlib.suppress(RuntimeError):  # no such folder
                dispatcher._cache = _CheckedCache(function)
        return dispatcher

    return decorate


def in_array(dtype: Any, axes: int = 1) -> Any:
    """Return the type of an array that is only read."""
    return types.Array(dtype, axes, "C", readonly=True)


def out_array(dtype: Any, axes: int = 1) -> Any:
    """Return the type of an array that is written: results, or scratch memory."""
    return types.Array(dtype, axes, "C")


class _CheckedCache(FunctionCache):
    """numba's cache of a function, in files with digests."""

    warned = False  # once a process, of the first function

    def __init__(self, function: Callable[..., Any]) -> None:
        super().__init__(function)
        locator = self._impl.locator
        self._cache_file = _CheckedFile(self._cache_path, self._impl.filename_base, locator.get_source_stamp())

    def save_overload(self, signature: Any, data: Any) -> None:
        """Save the compiled function if the file can be written; this process uses it in any case."""
        try:
            super().save_overload(signature, data)
        except OSError as error:
            if not _CheckedCache.warned:
                _log.warning(
                    "%s: compiled code cannot be cached (%s), so that every process compiles for some seconds; make "
                    "room there, or set NUMBA_CACHE_DIR to another folder",
                    *(self.cache_path, error.strerror or error),
                )
            _CheckedCache.warned = True


class _CheckedFile(IndexDataCacheFile):
    """Index and data of a cached function, each followed by a digest, which numba ignores."""

    def _load_index(self) -> Any:
        if not _is_whole(Path(self._index_path)):
            return {}
        try:
            return super()._load_index()
        except (AttributeError, ImportError):  # written by an earlier version, for a class that is gone
            return {}

    def _load_data(self, name: str) -> Any:
        path = Path(self._data_path(name))
        if not _is_whole(path):
            raise FileNotFoundError(path)  # lets numba compile the function
        return super()._load_data(name)

    @contextlib.contextmanager
    def _open_for_write(self, path: str) -> Iterator[io.BytesIO]:
        with super()._open_for_write(path) as file:
            content = io.BytesIO()
            yield content
            file.write(content.getvalue() + hashlib.sha256(content.getvalue()).digest())


def _is_whole(path: Path) -> bool:
    try:
        content = path.read_bytes()
    except OSError:
        return False
    return hashlib.sha256(content[:-_DIGEST_BYTES]).digest() == content[-_DIGEST_BYTES:]
