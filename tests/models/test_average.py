from pathlib import Path

import pytest
import torch

from asca_pillars.base.errors import ConfigError, TrainingError
from asca_pillars.config.pillar import NetworkConfig, PillarModel
from asca_pillars.config.tree import Config
from asca_pillars.models.average import average_checkpoints
from asca_pillars.models.build import build_model
from asca_pillars.models.checkpoint import Checkpoint, load_checkpoint
from tests.helpers.saved_checkpoint import save_checkpoint


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
