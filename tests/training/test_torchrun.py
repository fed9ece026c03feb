"""Training on several machines, as docs/TRAINING.md says: torchrun on each, here two addresses of one machine."""

import dataclasses
import os
import socket
import subprocess
import sys
from contextlib import ExitStack
from pathlib import Path

import pytest
import yaml

from asca_pillars.base.schema import to_dict
from asca_pillars.config.tree import TrainConfig
from asca_pillars.models.checkpoint import load_checkpoint
from tests.helpers.scenes import write_dataset
from tests.helpers.tiny_run import CONFIG

ADDRESSES = ("127.0.0.2", "127.0.0.1")  # of the machine that the others meet at, and of another


def free_port(address: str) -> int:
    with socket.socket() as probe:
        try:
            probe.bind((address, 0))
        except OSError:
            pytest.skip(f"this system has no address {address}")
        return int(probe.getsockname()[1])


def test_two_addresses_train_together(tmp_path: Path) -> None:
    data, out = write_dataset(tmp_path / "data", 9), tmp_path / "run"
    port = free_port(ADDRESSES[0])
    config = dataclasses.replace(CONFIG, train=TrainConfig(epochs=1, batch_size=2, learning_rate=1e-3))
    (tmp_path / "config.yaml").write_text(yaml.safe_dump(to_dict(config)))
    torchrun = [sys.executable, "-m", "torch.distributed.run"]
    meet = ["--nnodes", "2", "--nproc-per-node", "1", "--master-addr", ADDRESSES[0], "--master-port", str(port)]
    train = ["-m", "asca_pillars.cli", "train", str(tmp_path / "config.yaml"), "--data", str(data), "--out", str(out)]
    train += ["--devices", "1", "--num-nodes", "2"]
    with ExitStack() as stack:
        machines = [
            stack.enter_context(
                subprocess.Popen(
                    [*torchrun, *meet, "--node-rank", str(rank), "--local-addr", address, *train],
                    stdout=subprocess.PIPE,
                    stderr=subprocess.STDOUT,
                    text=True,
                    env=os.environ | {"OMP_NUM_THREADS": "1", "GLOO_SOCKET_IFNAME": "lo"},
                )
            )
            for rank, address in enumerate(ADDRESSES)
        ]
        try:
            texts = [machine.communicate(timeout=240)[0] for machine in machines]
        finally:
            for machine in machines:
                machine.kill()
    assert [machine.returncode for machine in machines] == [0, 0], "\n".join(texts)
    # Eight training frames, two to a batch, a batch for each machine at a time: one machine alone would take four.
    assert load_checkpoint(out / "checkpoints" / "last.ckpt").steps == 2
    assert [text.count("Trained:") for text in texts] == [1, 1]
