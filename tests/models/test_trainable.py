"""Every family computes a step where its weights are; what it leaves on the CPU a GPU refuses."""

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from asca_pillars.config.pillar import PillarModel
from asca_pillars.config.tree import Config
from asca_pillars.detection.spec import DetectorSpec
from asca_pillars.models.build import ScanDetector, build_model
from asca_pillars.models.trainable import Trainable, to_device
from asca_pillars.training.dataset import Batch, Collate, open_dataset
from tests.helpers.scenes import SPEC, write_dataset
from tests.helpers.second_device import SecondDevice, move_weights, on_gpu
from tests.helpers.tiny_run import CONFIG, NETWORK
from tests.models.pv_rcnn.tiny_pv_rcnn import EVERYTHING, VARIANTS, batch, frame, tiny_detector
from tests.models.two_stage.tiny_refine import opened_config, write_first_stage

PILLARS: dict[str, dict[str, Any]] = {
    **{f"CPA {cpa}": {"cpa": cpa} for cpa in ("none", "paper", "channel", "point", "linear")},
    "sparse neck": {"neck": "sparse"},
}


def learns_and_detects(detector: Trainable, inputs: Any, spec: DetectorSpec) -> None:
    assert isinstance(detector, torch.nn.Module)
    move_weights(detector)
    with SecondDevice():
        there = to_device(inputs, "cuda")
        detector.train()
        terms = detector.loss(detector.predict(there), there)
        assert all(map(on_gpu, terms.values()))
        total = torch.stack(list(terms.values())).sum()
    total.backward()
    with SecondDevice(), torch.inference_mode():
        detector.eval()
        assert len(detector.detect(detector.predict(there), spec)) == 2


def drawn(config: Config, root: Path) -> Any:
    frames = open_dataset(root, config, training=True)
    found = Collate(frames.preparation)([frames.sample(0, 0), frames.sample(0, 1)])
    assert isinstance(found, Batch)
    return found.inputs


@pytest.mark.parametrize("changes", PILLARS.values(), ids=PILLARS)
def test_pillars(tmp_path: Path, changes: dict[str, Any]) -> None:
    model = PillarModel(spec=SPEC, network=dataclasses.replace(NETWORK, **changes))
    inputs = drawn(dataclasses.replace(CONFIG, model=model), write_dataset(tmp_path, 3))
    learns_and_detects(build_model(model), inputs, SPEC)


def test_a_second_stage(tmp_path: Path) -> None:
    config = opened_config(write_first_stage(tmp_path / "first.ckpt"))
    inputs = drawn(config, write_dataset(tmp_path / "data", 3))
    learns_and_detects(build_model(config.model), inputs, config.model.spec)


@pytest.mark.parametrize("changes", [*VARIANTS.values(), EVERYTHING], ids=[*VARIANTS, "everything"])
def test_pv_rcnn(changes: dict[str, Any]) -> None:
    detector = tiny_detector(**changes)
    learns_and_detects(detector, batch(detector, frame(0), frame(1)), detector.model.spec)
    if not changes:
        empty = dataclasses.replace(frame(0), points=np.empty((0, 4), np.float32))
        learns_and_detects(detector, batch(detector, empty, empty), detector.model.spec)


def test_single_scans() -> None:
    detector = tiny_detector().eval()
    points, spec = frame(0).points, detector.model.spec.with_score_threshold(0.001)
    expected = ScanDetector(detector, spec)(points)
    move_weights(detector)
    with SecondDevice():
        found = ScanDetector(detector, spec)(points)
    assert len(found) > 0
    np.testing.assert_array_equal(found.boxes, expected.boxes)


def test_what_stays_on_the_cpu_is_refused() -> None:
    with SecondDevice():
        there = torch.ones(3).to("cuda")
        for refused in (lambda: there + torch.ones(3), lambda: there.index_select(0, torch.tensor([0])), there.numpy):
            with pytest.raises(RuntimeError, match="on the"):
                refused()
        detector = tiny_detector()
        inputs = to_device(batch(detector, frame(0), frame(1)), "cuda")
        with pytest.raises(RuntimeError, match="on the CPU"):
            detector.predict(inputs)  # its weights are still there
