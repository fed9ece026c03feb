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
from asca_pillars.models.build import build_model
from asca_pillars.models.checkpoint import Checkpoint, load_checkpoint
from asca_pillars.training.loop import train
from tests.helpers.saved_checkpoint import save_checkpoint
from tests.helpers.scenes import write_dataset
from tests.helpers.tiny_run import CONFIG, NETWORK, with_train

STILL = with_train(epochs=1, learning_rate=1e-12)
OTHER = dataclasses.replace(CONFIG, model=PillarModel(network=dataclasses.replace(NETWORK, pillar_channels=8)))


def test_a_run_can_start_from_other_weights(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    data, bundle, first = write_dataset(tmp_path / "data", 3), tmp_path / "bundle", tmp_path / "first.ckpt"
    torch.manual_seed(3)
    other = Checkpoint(CONFIG, build_model(CONFIG.model), 7)
    save_checkpoint(first, other)
    bundle.mkdir()
    first_weights = bundle / "weights.ckpt"
    first_weights.write_bytes(first.read_bytes())
    for module in (shipped, installation):
        monkeypatch.setattr(module, "shipped_models", lambda: {"a_model": bundle})
    assert [find_checkpoint(init) for init in (first, bundle, "a_model")] == [first, first_weights, first_weights]
    found = load_checkpoint(train(STILL, data, tmp_path / "run", init=first_weights)).detector.parameters()
    for expected, parameter in zip(other.detector.parameters(), found, strict=True):
        torch.testing.assert_close(parameter, expected)
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
