"""Loader processes and the batches that they send: the same tensors, and none of them through /dev/shm."""

import os
import signal
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from multiprocessing.connection import Connection
from multiprocessing.reduction import ForkingPickler
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
import torch
from torch import Tensor
from torch.utils._pytree import tree_flatten

from asca_pillars.base.errors import DatasetError, WorkerError
from asca_pillars.config.pillar import NetworkConfig, PillarModel
from asca_pillars.config.tree import Config
from asca_pillars.training.dataset import Batch, Collate, open_dataset
from asca_pillars.training.shared_batches import ShareCollated, SharedInputs, ignore_interrupts, loader_context
from tests.helpers.scenes import SPEC, write_dataset
from tests.models.pv_rcnn.tiny_pv_rcnn import tiny_config
from tests.models.two_stage.tiny_refine import opened_config, write_first_stage

pytestmark = pytest.mark.skipif(not hasattr(os, "memfd_create"), reason="this system has no memfd_create")


class Inner(NamedTuple):
    tensors: tuple[Tensor, ...]
    frames: int


class Outer(NamedTuple):
    inner: Inner
    nothing: None
    array: np.ndarray


def made_up() -> Outer:
    generator = torch.Generator().manual_seed(3)
    tensors = (
        torch.rand((7, 3), generator=generator),
        torch.zeros((0, 4), dtype=torch.int64),
        torch.tensor(5, dtype=torch.int8),
        torch.rand((4, 6), generator=generator, dtype=torch.float64).T,  # not contiguous
        torch.tensor([True, False, True]),
        torch.arange(100_000, dtype=torch.int32),
    )
    return Outer(Inner(tensors, 3), None, np.arange(4))


@contextmanager
def started(target: Callable[[Connection], None]) -> Iterator[tuple[Any, Connection]]:
    """A process as loaders start them, and the end of its connection here."""
    context = loader_context()
    here, there = context.Pipe()
    process = context.Process(target=target, args=(there,))
    process.start()
    yield process, here
    process.join(30)
    here.close()
    there.close()


def send(connection: Connection) -> None:
    connection.send({name: name in sys.modules for name in ("asca_pillars.training.dataset", "lightning")})
    connection.send(SharedInputs(made_up()))
    connection.recv()


def test_another_process_gets_the_same_tensors() -> None:
    with started(send) as (process, here):
        assert here.recv() == {"asca_pillars.training.dataset": True, "lightning": False}, "all it needs, not the loop"
        found = here.recv()
        here.send(None)
        process.join()
    expected = made_up()
    assert isinstance(found, Outer) and found.inner.frames == 3 and found.nothing is None
    assert np.array_equal(found.array, expected.array)
    for own, other in zip(found.inner.tensors, expected.inner.tensors, strict=True):
        assert own.dtype == other.dtype and own.shape == other.shape and torch.equal(own, other)
        assert own.data_ptr() % 64 == 0
    found.inner.tensors[0].zero_()  # it may be written
    assert int(found.inner.tensors[5][-1]) == 99_999  # and lives on when the other has ended


def answer(connection: Connection) -> None:
    ignore_interrupts()
    connection.send("ready")
    while connection.recv() is None:
        connection.send("still here")


def test_a_process_outlives_the_first_sigterm_of_its_job() -> None:
    """As Ctrl-C, which reaches every process of a terminal; the second one is the loader's own."""
    with started(answer) as (process, here):
        assert here.poll(30) and here.recv() == "ready"
        for number in (signal.SIGINT, signal.SIGTERM):
            os.kill(process.pid, number)
            here.send(None)
            assert here.poll(30) and here.recv() == "still here"
        process.terminate()
    assert process.exitcode == -signal.SIGTERM


def a_batch(inputs: Any) -> Batch:
    return Batch(["000000"], [np.zeros((0, 7), np.float32)], [np.zeros(0, np.int64)], inputs)


def inputs_of(family: str, root: Path) -> Any:
    """A batch of two frames of this family of detectors."""
    match family:
        case "pv_rcnn":
            config = tiny_config()
        case "pillar_refine":
            config = opened_config(write_first_stage(root / "first.ckpt"))
        case _:
            network = NetworkConfig(neck="sparse" if family == "sparse" else "dense")
            config = Config(model=PillarModel(spec=SPEC, network=network))
    frames = open_dataset(write_dataset(root / "data", 3), config, training=True)
    batch = Collate(frames.preparation)([frames.sample(0, 0), frames.sample(0, 1)])
    assert isinstance(batch, Batch)
    return batch.inputs


@pytest.mark.parametrize("family", ["pillar", "sparse", "pv_rcnn", "pillar_refine"])
def test_no_tensor_of_any_family_is_left_to_torch(family: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Torch stores what it pickles for another process in /dev/shm."""

    def refuse(tensor: Tensor) -> Any:
        raise AssertionError(f"{tuple(tensor.shape)} goes through /dev/shm")

    inputs = inputs_of(family, tmp_path)
    count = sum(isinstance(leaf, Tensor) for leaf in tree_flatten(inputs)[0])
    assert count > 5
    monkeypatch.setitem(ForkingPickler._extra_reducers, Tensor, refuse)  # type: ignore[attr-defined]
    with pytest.raises(AssertionError, match="goes through"):
        ForkingPickler.dumps(a_batch(inputs))
    batch = ShareCollated(lambda _: a_batch(inputs))([])
    assert isinstance(batch, Batch)
    found = ForkingPickler.loads(ForkingPickler.dumps(batch)).inputs
    assert type(found) is type(inputs)
    assert sum(isinstance(leaf, Tensor) for leaf in tree_flatten(found)[0]) == count


def test_errors_pass_and_a_batch_that_finds_no_room_is_one(monkeypatch: pytest.MonkeyPatch) -> None:
    error = DatasetError("a frame is damaged")
    assert ShareCollated(lambda _: error)([]) is error

    def full(_: str) -> int:
        raise OSError(24, "Too many open files")

    monkeypatch.setattr("os.memfd_create", full)
    found = ShareCollated(lambda _: a_batch(made_up()))([error, error])
    assert isinstance(found, WorkerError)
    assert "2 frames" in str(found) and "Too many open files" in str(found) and "data.workers=0" in str(found)
