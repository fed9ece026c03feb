"""The weights that a new run starts from: another run's, or those that a bundle holds."""

import dataclasses
from pathlib import Path

import pytest
import torch

from asca_deploy import shipped
from asca_deploy.shipped import find_checkpoint
from asca_pillars.base import installation
from asca_pillars.base.errors import BundleError, TrainingError
from asca_pillars.config.pillar import PillarModel
from asca_pillars.models.checkpoint import load_checkpoint
from asca_pillars.training.loop import train
from tests.helpers.scenes import write_dataset
from tests.helpers.tiny_run import CONFIG, NETWORK

STILL = dataclasses.replace(CONFIG, train=dataclasses.replace(CONFIG.train, epochs=1, learning_rate=1e-12))
OTHER = dataclasses.replace(CONFIG, model=PillarModel(network=dataclasses.replace(NETWORK, pillar_channels=8)))


def test_a_run_can_start_from_other_weights(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    data = write_dataset(tmp_path / "data", 3)
    first = train(CONFIG, data, tmp_path / "first")
    bundle = tmp_path / "bundle"
    bundle.mkdir()
    first.with_name("weights.ckpt").rename(bundle / "weights.ckpt")
    for module in (shipped, installation):
        monkeypatch.setattr(module, "shipped_models", lambda: {"a_model": bundle})
    sources: dict[str | Path, Path] = {
        first: first,
        bundle: bundle / "weights.ckpt",
        "a_model": bundle / "weights.ckpt",
    }
    for number, (init, source) in enumerate(sources.items()):
        found = load_checkpoint(
            train(STILL, data, tmp_path / str(number), init=find_checkpoint(init))
        ).detector.parameters()
        for expected, parameter in zip(load_checkpoint(source).detector.parameters(), found, strict=True):
            torch.testing.assert_close(parameter, expected, msg=f"{parameter.shape} from {init}")
    for init, error, message in (
        (first, TrainingError, r"another network: \S+ is \(16, 9\) there and \(8, 9\) in this configuration"),
        ("another", BundleError, "no bundle of that name ships"),
        (data, BundleError, r"data: holds no weights\.ckpt, .* a_model has one"),
        (tmp_path / "none.ckpt", TrainingError, "no such checkpoint"),
    ):
        with pytest.raises(error, match=message) as caught:
            train(OTHER, data, tmp_path / "refused", init=find_checkpoint(init))
        assert "\n" not in str(caught.value)
    assert not (tmp_path / "refused").exists()  # the corrected command finds nothing in its way
