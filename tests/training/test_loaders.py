"""Processes that load batches: when one fails, the run ends with one line, and never waits for it."""

import os
import subprocess
import sys
import time
from pathlib import Path

import pytest
import yaml

from asca_pillars.base.errors import WorkerError
from asca_pillars.base.schema import to_dict
from asca_pillars.config.pillar import NetworkConfig, PillarModel
from asca_pillars.config.tree import Config, TrainConfig
from asca_pillars.training import loaders
from asca_pillars.training.loaders import BatchLoader
from asca_pillars.training.shared_batches import loader_context, start_loader_process
from tests.helpers.scenes import SPEC, write_dataset
from tests.training.failing_numbers import Numbers


def loader_of(what: str, timeout: float = 1) -> BatchLoader:
    return BatchLoader(
        Numbers(what),  # type: ignore[arg-type]
        batch_size=2,
        num_workers=2,
        collate_fn=list,
        persistent_workers=True,
        worker_init_fn=start_loader_process,
        multiprocessing_context=loader_context(),
        timeout=timeout,
    )


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


SMALLER_AND_SMALLER = """
import subprocess, sys
from asca_pillars.cli.main import main
command, out = sys.argv[1:-1], sys.argv[-1]
for size in ("1m", "4k"):
    subprocess.run(["mount", "-t", "tmpfs", "-o", f"size={size}", "tmpfs", "/dev/shm"], check=True)
    sys.argv = ["asca", *command, "--out", f"{out}/{size}"]
    try:
        main()
        code = 0
    except SystemExit as end:
        code = end.code
    print(f"{size}: {code}", file=sys.stderr, flush=True)
"""


def test_training_where_shared_memory_is_small(tmp_path: Path) -> None:
    """It goes on, or ends with the remedy where there is no room for the locks of a queue."""
    alone = ["unshare", "--mount", "--map-root-user"]
    mount = ["mount", "-t", "tmpfs", "tmpfs", "/dev/shm"]
    if sys.platform != "linux" or subprocess.run([*alone, *mount], capture_output=True).returncode:
        pytest.skip("a file system of its own cannot be mounted here")
    data = write_dataset(tmp_path / "data", 9)
    network = NetworkConfig(pillar_channels=8, block_channels=(8, 8, 8), block_convs=(1, 1, 1), upsample_channels=8)
    config = Config(model=PillarModel(spec=SPEC, network=network), train=TrainConfig(epochs=1, batch_size=4))
    (tmp_path / "config.yaml").write_text(yaml.safe_dump(to_dict(config)))
    command = [sys.executable, "-c", SMALLER_AND_SMALLER, "train", str(tmp_path / "config.yaml"), "--data", str(data)]
    run = subprocess.run([*alone, *command, str(tmp_path)], capture_output=True, text=True, timeout=300)
    _, goes_on, ends = run.stderr.partition("1m: 0\n")
    assert goes_on and (tmp_path / "1m" / "checkpoints" / "last.ckpt").exists(), run.stderr
    assert len(lines := ends.splitlines()) == 2, ends
    assert "data.workers=0" in lines[0] and "--shm-size" in lines[0]
    assert int(lines[1].removeprefix("4k: ")) > 1


LEFT_OPEN = """
if __name__ == "__main__":  # loader processes import this file, too
    from tests.training.test_loaders import loader_of
    loader = loader_of("")
    next(iter(loader))
"""


def test_a_program_ends_whose_loader_was_left_open(tmp_path: Path) -> None:
    """Loader processes do not follow the first SIGTERM, and Python sends them no second one."""
    (tmp_path / "main.py").write_text(LEFT_OPEN)
    path = os.pathsep.join([str(Path(__file__).parents[2]), os.environ.get("PYTHONPATH", "")])
    subprocess.run(
        [sys.executable, str(tmp_path / "main.py")], check=True, timeout=120, env=os.environ | {"PYTHONPATH": path}
    )
