"""The order of frames, and processes that load batches: when one fails, the run ends with one line, without waiting."""

import os
import subprocess
import sys
import time
from pathlib import Path

import pytest

from asca_pillars.base.errors import TrainingError, WorkerError
from asca_pillars.training import loaders
from asca_pillars.training.loaders import EpochSampler
from tests.training.failing_numbers import loader_of

pytestmark = pytest.mark.filterwarnings("ignore:This DataLoader will create")  # on a machine with one core


def test_sampler_goes_on_where_the_steps_stopped() -> None:
    step = 0
    sampler = EpochSampler(11, 2, seed=0, step=lambda: step)
    epochs = []
    for _ in range(2):
        epochs.append(list(sampler))
        step += len(sampler)
    assert [len(epoch) for epoch in epochs] == [5, 5] and epochs[0] != epochs[1]
    step = 5 + 3
    assert list(sampler) == epochs[1][3:]
    assert {epoch for batch in epochs[1] for epoch, _ in batch} == {1}


def test_ranks_share_an_epoch() -> None:
    ranks = [EpochSampler(11, 2, 0, lambda: 0, rank=rank, world_size=2) for rank in range(2)]
    numbers = [{number for batch in sampler for _, number in batch} for sampler in ranks]
    assert [len(sampler) for sampler in ranks] == [2, 2]
    assert len(numbers[0]) == len(numbers[1]) == 4 and not numbers[0] & numbers[1]


def test_validation_sees_every_frame_once() -> None:
    assert [number for batch in EpochSampler(5, 2, 0, None) for _, number in batch] == [0, 1, 2, 3, 4]


def test_validation_gives_every_rank_as_many_batches() -> None:
    ranks = [EpochSampler(5, 2, 0, None, rank=rank, world_size=3) for rank in range(3)]
    seen = [[number for batch in sampler for _, number in batch] for sampler in ranks]
    assert seen == [[0, 3], [1, 4], [2, 0]] and [len(sampler) for sampler in ranks] == [1, 1, 1]


def test_too_few_frames_for_a_batch() -> None:
    with pytest.raises(TrainingError, match="3 training frames do not fill one batch of 4"):
        EpochSampler(3, 4, 0, lambda: 0)


def test_batches_come_in_order_epoch_after_epoch() -> None:
    loader = loader_of("")
    for _ in range(2):
        assert list(loader) == [[0, 1], [2, 3], [4, 5], [6, 7], [8, 9], [10, 11]]


def test_an_epoch_begins_while_processes_are_at_the_last_one() -> None:
    loader = loader_of("slow", timeout=0.3)
    assert next(iter(loader)) == [0, 1]
    assert list(loader) == [[0, 1], [2, 3], [4, 5], [6, 7], [8, 9], [10, 11]]


@pytest.mark.parametrize(
    ("what", "message"),
    [("SIGKILL", "exited unexpectedly"), ("unsendable", "exited unexpectedly"), ("SIGSTOP", "no batch in 4 seconds")],
)
def test_a_process_that_fails_ends_the_run(what: str, message: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(loaders, "MOST_LOOKS", 4)
    monkeypatch.setattr(loaders, "LOOK_AGAIN_S", 1)
    start = time.monotonic()
    with pytest.raises(WorkerError, match=f"{message}.*data.workers=0") as caught:
        list(loader_of(what))
    assert "\n" not in str(caught.value)
    assert time.monotonic() - start < 60


MAIN = """
import subprocess, sys
from asca_pillars.base.errors import WorkerError
from tests.training.failing_numbers import loader_of
if __name__ == "__main__":  # loader processes import this file, too
    left_open = loader_of("large", timeout=30)
    for size in sys.argv[1:]:
        subprocess.run(["mount", "-t", "tmpfs", "-o", f"size={size}", "tmpfs", "/dev/shm"], check=True)
        try:
            print(size, next(iter(left_open if size == "1m" else loader_of("large"))).inputs.nbytes)
        except WorkerError as error:
            print(size, error)
            subprocess.run(["umount", "/dev/shm"], check=True)  # locks of the first one are below
    if not sys.argv[1:]:
        next(iter(left_open))
"""


def test_a_program_ends_whose_loader_was_left_open_and_whose_shared_memory_is_small(tmp_path: Path) -> None:
    """Loader processes do not follow the first SIGTERM, and Python sends them no second one.

    A batch is larger than the shared memory; where there is no room for the locks of a queue, the remedy is told.
    """
    (tmp_path / "main.py").write_text(MAIN)
    path = os.pathsep.join([str(Path(__file__).parents[2]), os.environ.get("PYTHONPATH", "")])
    program = [sys.executable, str(tmp_path / "main.py")]
    alone = ["unshare", "--mount", "--map-root-user"]
    mount = ["mount", "-t", "tmpfs", "tmpfs", "/dev/shm"]
    if mounts := sys.platform == "linux" and not subprocess.run([*alone, *mount], capture_output=True).returncode:
        program = [*alone, *program, "1m", "4k"]
    environment = os.environ | {"PYTHONPATH": path}
    run = subprocess.run(program, capture_output=True, text=True, timeout=120, env=environment)
    assert run.returncode == 0 and "Traceback" not in run.stderr, run.stderr
    if not mounts:
        pytest.skip("a file system of its own cannot be mounted here")
    large, ends = run.stdout.splitlines()
    assert large == "1m 4000000"
    assert ends.startswith("4k ") and "data.workers=0" in ends and "--shm-size" in ends
