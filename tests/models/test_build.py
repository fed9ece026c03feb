"""The small form of a checkpoint, and what its weights are known by.

A checkpoint's network behind the interface of the runtime.
"""

import pickle
from pathlib import Path

import numpy as np
import pytest
import torch

from asca_pillars.base.errors import TrainingError
from asca_pillars.config.pillar import NetworkConfig, PillarModel
from asca_pillars.config.tree import Config
from asca_pillars.detection.decode import HeadMaps
from asca_pillars.models.build import Checkpoint, ScanDetector, build_model, load_checkpoint
from asca_pillars.models.checkpoint_file import save_weights, weights_sha256
from asca_pillars.models.openpcdet.import_checkpoint import read_foreign
from asca_pillars.models.pillar.network import build_pillar_detector
from asca_pillars.models.pillar.preparation import batch_pillars
from asca_pillars.training.callbacks import LAST, checkpoint_to_resume
from tests.helpers.saved_checkpoint import checkpoint_content
from tests.helpers.scenes import make_scene
from tests.helpers.tiny_run import CONFIG

NARROW = Config(model=PillarModel(network=NetworkConfig(block_channels=(4, 4, 4), upsample_channels=4)))


def test_weights_at_the_paper_s_width_are_small_and_are_the_same_to_three_digits(tmp_path: Path) -> None:
    config = Config(model=PillarModel())
    torch.manual_seed(0)
    untrained = Checkpoint(config, build_model(config.model), 7)
    state = untrained.detector.state_dict()
    torch.save(checkpoint_content(untrained) | {"optimizer": 1}, tmp_path / "last.ckpt")
    path = tmp_path / "weights.ckpt"
    save_weights(tmp_path / "last.ckpt", path)
    assert path.stat().st_size < 8 * 2**20
    loaded = load_checkpoint(path)
    assert loaded.steps == 7 and loaded.config == config and loaded.expected_input is None
    for name, value in loaded.detector.state_dict().items():
        assert value.dtype == state[name].dtype
        torch.testing.assert_close(value, state[name], rtol=1e-3, atol=1e-7, msg=name)
    assert weights_sha256(loaded.detector.state_dict()) != weights_sha256(state)


def test_nobody_is_told_to_execute_what_is_in_a_file(tmp_path: Path) -> None:
    path = tmp_path / "scan.bin"
    path.write_bytes(np.arange(40, dtype="<f4").tobytes())  # zeros first: no pickle begins so
    for read in (load_checkpoint, read_foreign):
        with pytest.raises(TrainingError, match=r"scan\.bin: .*nothing in it was executed") as refusal:
            read(path)
        assert "weights_only" not in str(refusal.value) and "\n" not in str(refusal.value)
    (tmp_path / LAST).write_bytes(path.read_bytes())
    with pytest.raises(TrainingError, match="nothing in it was executed") as refusal:
        checkpoint_to_resume(tmp_path, NARROW.model)
    assert "weights_only" not in str(refusal.value)


def test_what_is_none_of_ours_is_named(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    path, state = tmp_path / "x.ckpt", {"a": torch.zeros(2)}
    whole = checkpoint_content(Checkpoint(NARROW, build_model(NARROW.model), 7))
    ours = "x.ckpt: not a checkpoint of `asca train`, or damaged"
    for content, message in (
        ({name: value for name, value in whole.items() if name != "global_step"}, f"{ours} .*no 'global_step'"),
        (whole | {"global_step": None}, f"{ours} .*int"),
        ({"model_state": state}, "a checkpoint of OpenPCDet; convert it with `asca import-weights`"),
        ({"meta": {}, "state_dict": state}, "a checkpoint of mmdetection3d; convert it with `asca import-weights`"),
        (state, "no 'hyper_parameters'"),
        (torch.zeros(3), "it holds a Tensor, where a checkpoint holds a dictionary"),
        (None, "it holds a NoneType"),
    ):
        torch.save(content, path)
        with pytest.raises(TrainingError, match=message):
            load_checkpoint(path)
    for data, message in ((b"hello", "it was not written by torch.save"), (pickle.dumps({"a": 1}), "not a checkpoint")):
        path.write_bytes(data)
        with pytest.raises(TrainingError, match=message):
            load_checkpoint(path)
    assert capfd.readouterr().err == ""  # torch warns of other pickles, which are not the user's to read


def test_weights_are_known_by_names_shapes_and_values() -> None:
    weights = {"a": torch.arange(6.0).reshape(2, 3), "b": torch.tensor(1)}
    known = weights_sha256(weights)
    assert weights_sha256({"b": weights["b"], "a": weights["a"].clone()}) == known
    others = (
        {"a": weights["a"].reshape(3, 2), "b": weights["b"]},
        {"a": weights["a"], "c": weights["b"]},
        {"a": weights["a"] + 1, "b": weights["b"]},
        {"a": weights["a"]},
    )
    assert len({known, *map(weights_sha256, others)}) == 5


def test_scans_one_by_one_are_what_a_batch_of_them_gives() -> None:
    """And the second scan does not inherit the first."""
    torch.manual_seed(3)
    assert isinstance(CONFIG.model, PillarModel)
    network = build_pillar_detector(CONFIG.model).eval()
    spec = CONFIG.model.spec.with_score_threshold(0.001)
    detect = ScanDetector(network, spec)
    scans = [make_scene(seed)[0] for seed in (1, 2)]
    with torch.inference_mode():
        maps = network(batch_pillars([spec.pillarize(points) for points in scans]))
    for index in (0, 1, 0):
        expected = spec.decode(HeadMaps(*(part[index].numpy() for part in maps)))
        found = detect(scans[index])
        assert len(found) == len(expected) > 0 and found.names == expected.names
        np.testing.assert_allclose(found.boxes, expected.boxes, atol=1e-4)
        np.testing.assert_allclose(found.scores, expected.scores, atol=1e-5)
    assert len(ScanDetector(network, CONFIG.model.spec)(np.empty((0, 4), np.float32))) == 0
