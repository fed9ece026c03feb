"""Training of a pillar detector by the outputs of a trained one, its teacher (arXiv 1503.02531)."""

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from asca_pillars.base.errors import ConfigError
from asca_pillars.config.pillar import PillarModel
from asca_pillars.config.tree import Config
from asca_pillars.detection.decode import PostProcess
from asca_pillars.models.pillar.loss import distillation_loss
from asca_pillars.models.pillar.network import PillarOutputs
from asca_pillars.models.pillar.trained import load_trained_pillars
from asca_pillars.ops.pillar.spec import PillarSpec


class Distillation:
    """Terms of the loss that a teacher adds. No `nn.Module`, so that a checkpoint does not hold the teacher's weights.

    Args:
        config: of the detector that learns.
        teacher: a checkpoint of `asca train`, or a bundle that holds one: its folder, or the name of one that ships.

    Raises:
        ConfigError: `config` is of another kind, or the teacher has other pillars, anchors or active cells.
        AscaError: as `load_trained_pillars`.
    """

    def __init__(self, config: Config, teacher: str) -> None:
        model = config.model
        if not isinstance(model, PillarModel):
            raise ConfigError(f"train.teacher = {teacher}: only model.kind pillar learns from one; leave it out")
        self._network, spec, _ = load_trained_pillars(teacher, "train.teacher")
        self._loss, self._weight = model.loss, config.train.teacher_weight
        ours, theirs = model.network, self._network.preparation
        if _anchors(spec) != _anchors(model.spec):
            raise ConfigError(
                f"train.teacher = {teacher}: its model.spec is another; give both the same grid, limits and classes"
            )
        if theirs.active_cells != (ours.active_cells if ours.neck == "sparse" else None):
            raise ConfigError(
                f"train.teacher = {teacher}: its neck is another; give both the same model.network.neck and "
                "model.network.active_cells"
            )

    def __call__(self, outputs: PillarOutputs, batch: Any) -> Mapping[str, Tensor]:
        """Return the weighted terms by name, scalars, for the detector's outputs of a batch (`LabeledPillars`)."""
        network = self._network.to(batch.pillars.features.device)
        with torch.no_grad():
            wanted = network(batch.pillars)
        terms = distillation_loss(outputs.maps, wanted, self._loss)._asdict()
        return {name: self._weight * term for name, term in terms.items()}


def _anchors(spec: PillarSpec) -> PillarSpec:
    """Return the spec without what neither input nor anchors depend on."""
    classes = tuple(replace(one, positive_iou=1.0, negative_iou=0.0, score_threshold=0.0) for one in spec.classes)
    return replace(spec, post=PostProcess(), classes=classes)
