"""Inspecting for a training whose anchors are matched without thresholds (`model.loss.assigner: atss`)."""

import dataclasses
import json
from pathlib import Path

import numpy as np
import yaml

from asca_pillars.base.schema import to_dict
from asca_pillars.cli.inspect import inspect
from asca_pillars.config.pillar import LossConfig, PillarModel
from asca_pillars.data.frames import LabeledFrame
from asca_pillars.data.inspection.measurements import MatchOutcome, match
from asca_pillars.detection.targets import assign_targets
from asca_pillars.training.dataset import open_dataset
from tests.data.inspection.conftest import FRAMES
from tests.data.inspection.inspected_data import CONFIG
from tests.helpers.scenes import SPEC


def test_outcomes_by_hand() -> None:
    """A short car, which no anchor overlaps by positive_iou, and tiny boxes that have the same best anchors."""
    x, y = SPEC.anchors[20, 15, 0, :2]
    boxes = np.array([[x, y, -1.0, 2.0, 1.6, 1.56, 0.0]] + [[x, y + 5, -0.6, 0.3, 0.3, 1.7, 0.0]] * 2, np.float32)
    frame = LabeledFrame("0", np.empty((0, 4), np.float32), boxes, np.array([0, 1, 1]))
    outcomes, positives = match(frame, SPEC, "atss")
    assert outcomes.tolist() == [MatchOutcome.OVERLAPPED, MatchOutcome.MISSED, MatchOutcome.OVERLAPPED]
    targets = assign_targets(SPEC.anchors, SPEC.classes, boxes, frame.labels, "atss")
    assert positives.tolist() == np.bincount(frame.labels[targets.matched], minlength=3).tolist()


def test_the_command_counts_the_positives_of_the_training_loader(clean: Path, tmp_path: Path) -> None:
    config = dataclasses.replace(CONFIG, model=PillarModel(spec=SPEC, loss=LossConfig(assigner="atss")))
    path, report = tmp_path / "config.yaml", tmp_path / "report.json"
    path.write_text(yaml.safe_dump(to_dict(config)))
    inspect(clean, config=path, json=report)
    frames = open_dataset(clean, config, training=False)
    states = np.stack([frames.sample(0, number).prepared.targets.state for number in range(FRAMES)])
    for index, facts in enumerate(json.loads(report.read_text())["classes"]):
        assert facts["positives"] == (states[..., 2 * index : 2 * index + 2] == 1).sum() > 0
        assert facts["forced"] == 0
