"""What holds for every test."""

import contextlib
import copy
import functools
import gc
import importlib
import logging
import os
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from filelock import FileLock
from hypothesis import settings

import asca_pillars

# How long an example takes depends on what else the machine does, and says nothing about whether it is right.
settings.register_profile("untimed", deadline=None)
settings.load_profile("untimed")

# Before torch is imported: pytest has a process for each core, and networks as small as here are slower on several.
os.environ.setdefault("OMP_NUM_THREADS", "1")

# What is imported stays to the end. Looking through it for garbage again and again took an eighth of the suite's time.
gc.disable()


def pytest_sessionstart(session: pytest.Session) -> None:
    """Divide the compiling of kernels among pytest's processes: each would compile all, which takes 20 s."""
    worker = getattr(session.config, "workerinput", None)
    if worker is None or session.config.option.basetemp is None:  # one process, or one elsewhere
        return
    package = Path(asca_pillars.__file__).parent
    kernels = sorted(path.relative_to(package.parent) for path in package.glob("*/**/*kernels.py"))
    first = int(worker["workerid"].removeprefix("gw")) * len(kernels) // worker["workercount"]
    for path in kernels[first:] + kernels[:first]:
        module = ".".join(path.with_suffix("").parts)
        with FileLock(Path(session.config.option.basetemp).parent / f"{module}.lock"):
            importlib.import_module(module)


def pytest_collection_finish() -> None:
    """From here on garbage is collected, of what the tests make."""
    gc.freeze()
    gc.set_threshold(20_000, 10, 10)
    gc.enable()


@pytest.fixture(autouse=True)
def _runtime_log() -> Iterator[None]:
    """Commands silence the runtime's log for the rest of their process, which here goes on with other tests."""
    log = logging.getLogger("asca_pillars")
    before = log.level
    yield
    log.setLevel(before)


@pytest.fixture(scope="session", autouse=True)
def _onnx_makes_nothing_twice(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """torch.onnx reads and registers its thousand operators anew for each graph: half of a small network's export.

    Networks that several tests export are exported for the first of them.
    """
    if "torch" not in sys.modules:  # tests that do without need not wait for it
        yield
        return
    from tests.helpers.kept_exports import exports_kept

    with pytest.MonkeyPatch.context() as patch, exports_kept(tmp_path_factory):
        with contextlib.suppress(ImportError, AttributeError):  # a torch that has it elsewhere: exports take longer
            _keep_registry(patch)
        yield


def _keep_registry(patch: pytest.MonkeyPatch) -> None:
    import torch._export.utils as exporting
    from torch.onnx._internal.exporter._registration import ONNXRegistry

    read = functools.cache(ONNXRegistry.from_torchlib)

    def from_torchlib(**version: Any) -> ONNXRegistry:
        registry = copy.copy(read(**version))
        registry.functions = {target: list(forms) for target, forms in registry.functions.items()}
        return registry

    patch.setattr(ONNXRegistry, "from_torchlib", staticmethod(from_torchlib))
    patch.setattr(exporting, "_materialize_cpp_cia_ops", functools.cache(exporting._materialize_cpp_cia_ops))
