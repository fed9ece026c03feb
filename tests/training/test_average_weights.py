"""Batch normalization of a checkpoint, from frames: torch's own running statistics of the same network and batches."""

import dataclasses
from pathlib import Path

import pytest
import torch
from torch import nn

from asca_pillars.base.errors import ConfigError, DatasetError, TrainingError
from asca_pillars.base.progress import Reporter
from asca_pillars.config.pillar import NetworkConfig, PillarModel
from asca_pillars.config.tree import Config, DataConfig
from asca_pillars.models.build import Checkpoint, build_model, load_checkpoint
from asca_pillars.training.average_weights import BATCH_FRAMES, average_checkpoints, update_batch_norm
from asca_pillars.training.dataset import open_dataset
from tests.helpers.saved_checkpoint import save_checkpoint
from tests.helpers.scenes import SPEC, write_dataset

NETWORK = NetworkConfig(block_channels=(4, 4, 4), upsample_channels=4)
CONFIG = Config(
    model=PillarModel(spec=SPEC, network=NETWORK), data=DataConfig(train_set="none", val_set="none", workers=0)
)


def test_statistics_are_those_of_the_frames_and_weights_stay(tmp_path: Path) -> None:
    data, path = write_dataset(tmp_path / "data", 3), tmp_path / "average.ckpt"
    torch.manual_seed(0)
    detector = build_model(CONFIG.model)
    save_checkpoint(path, Checkpoint(CONFIG, detector, 7))
    saved = detector.state_dict()
    with pytest.raises(DatasetError, match=r"none\.txt: no such split"):
        update_batch_norm(path, data)
    steps: list[tuple[str, int, int]] = []
    update_batch_norm(path, data, "training", frames=2, reporter=_recorder(steps))
    assert steps[-1] == ("Batch normalization", 1, 1) and BATCH_FRAMES > 2
    loaded = load_checkpoint(path)
    assert loaded.steps == 7 and loaded.config == CONFIG

    insert = dataclasses.replace(CONFIG.augment.insert, method="none")
    config = dataclasses.replace(
        CONFIG,
        augment=dataclasses.replace(CONFIG.augment, insert=insert),
        data=dataclasses.replace(CONFIG.data, train_set="training"),
    )
    frames = open_dataset(data, config, training=True)
    candidates = []
    for pair in ((0, 1), (0, 2), (1, 2)):
        detector = build_model(CONFIG.model)
        detector.load_state_dict(loaded.detector.state_dict())
        for part in detector.modules():
            if isinstance(part, nn.BatchNorm1d | nn.BatchNorm2d):
                part.momentum = 1.0  # the statistics of the last batch
        samples = [frames.sample(0, number).prepared for number in pair]
        with torch.no_grad():
            detector.train().predict(frames.preparation.collate(samples))
        candidates.append(detector.state_dict())
    state = loaded.detector.state_dict()
    names = [name for name in state if "running" in name]
    off = sorted(max(float((each[name] - state[name]).abs().max()) for name in names) for each in candidates)
    assert off[0] < 1e-4 < 1e-3 < off[1]
    for name, value in saved.items():
        assert name in names or torch.equal(state[name], value), name


def _recorder(steps: list[tuple[str, int, int]]) -> Reporter:
    return Reporter(lambda step, done, total: steps.append((step, done, total)))


def checkpoint(path: Path, seed: int, width: int = 4) -> dict[str, torch.Tensor]:
    """Save random weights, statistics of the normalization too; return them."""
    config = Config(model=PillarModel(network=NetworkConfig(block_channels=(width, 4, 4), upsample_channels=4)))
    torch.manual_seed(seed)
    detector = build_model(config.model)
    for name, value in detector.state_dict().items():
        if name.endswith("running_var"):
            value.uniform_(0.5, 2)
    save_checkpoint(path, Checkpoint(config, detector, 10 + seed))
    return detector.state_dict()


def test_each_array_is_the_weighted_mean(tmp_path: Path) -> None:
    paths = [tmp_path / f"{seed}.ckpt" for seed in range(3)]
    states = [checkpoint(path, seed) for seed, path in enumerate(paths)]
    average_checkpoints(paths, tmp_path / "mean.ckpt")
    average_checkpoints(paths, tmp_path / "weighted.ckpt", [3, 1, 0])
    for out, shares in (("mean.ckpt", [1 / 3, 1 / 3, 1 / 3]), ("weighted.ckpt", [0.75, 0.25, 0])):
        loaded = load_checkpoint(tmp_path / out)
        assert loaded.steps == 10
        for name, value in loaded.detector.state_dict().items():
            expected = sum(share * state[name] for share, state in zip(shares, states, strict=True))
            torch.testing.assert_close(value, expected.to(value.dtype), msg=name)  # type: ignore[union-attr]


def test_refusals(tmp_path: Path) -> None:
    one, other, wide = (tmp_path / f"{name}.ckpt" for name in ("one", "other", "wide"))
    for seed, path in enumerate((one, other)):
        checkpoint(path, seed)
    checkpoint(wide, 0, width=8)
    out = tmp_path / "out.ckpt"
    with pytest.raises(ConfigError, match="1 checkpoint: give two or more"):
        average_checkpoints([one], out)
    for shares in ([1.0], [1.0, -1.0], [0.0, 0.0], [float("nan"), 1.0]):
        with pytest.raises(ConfigError, match="give one for each of the 2 checkpoints"):
            average_checkpoints([one, other], out, shares)
    with pytest.raises(TrainingError, match=r"wide\.ckpt: weights of another network: .* average checkpoints of one"):
        average_checkpoints([one, wide], out)
    with pytest.raises(TrainingError, match="no such checkpoint"):
        average_checkpoints([one, tmp_path / "none.ckpt"], out)
    assert not out.exists()
