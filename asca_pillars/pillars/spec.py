"""One detector's numbers, all that training and the vehicle must agree on. `bundle.json` carries it."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from asca_pillars.errors import ConfigError
from asca_pillars.geometry.anchors import KITTI_CLASSES, ClassSpec, make_anchors
from asca_pillars.geometry.decode import HeadMaps, PostProcess, decode
from asca_pillars.geometry.detections import Detections
from asca_pillars.pillars.grid import PillarGrid
from asca_pillars.pillars.pillarize import PillarLimits, Pillars, pillarize


@dataclass(frozen=True)
class DetectorSpec:
    """Grid, input limits, classes and post-processing; the defaults are the paper's values.

    Raises:
        ConfigError: if there is no class or two have the same name.
    """

    grid: PillarGrid = field(default_factory=PillarGrid)
    limits: PillarLimits = field(default_factory=PillarLimits)
    classes: tuple[ClassSpec, ...] = KITTI_CLASSES
    post: PostProcess = field(default_factory=PostProcess)

    __pydantic_config__: ClassVar[dict[str, str]] = {"extra": "forbid"}

    def __post_init__(self) -> None:
        if not self.classes:
            raise ConfigError("classes is empty: a detector needs at least one class")
        if len(set(self.class_names)) < len(self.classes):
            raise ConfigError(f"classes {', '.join(self.class_names)} must have different names")

    @cached_property
    def class_names(self) -> tuple[str, ...]:
        """Names in the order of the labels 0, 1, ..."""
        return tuple(spec.name for spec in self.classes)

    @cached_property
    def anchors(self) -> NDArray[np.float32]:
        """(H, W, A, 7), see `make_anchors`. Read-only."""
        anchors = make_anchors(self.grid, self.classes)
        anchors.flags.writeable = False
        return anchors

    def with_score_threshold(self, score: float | Mapping[str, float]) -> "DetectorSpec":
        """The same detector that reports detections from `score` on: of every class, or of those named, by name.

        Raises:
            ConfigError: no such class, or no score between 0 and 1.
        """
        scores = score if isinstance(score, Mapping) else dict.fromkeys(self.class_names, score)
        if unknown := [name for name in scores if name not in self.class_names]:
            raise ConfigError(f"{unknown[0]}: no such class; there are {', '.join(self.class_names)}")
        return replace(
            self,
            classes=tuple(
                replace(spec, score_threshold=scores.get(spec.name, spec.score_threshold)) for spec in self.classes
            ),
        )

    def pillarize(self, points: NDArray[np.float32], rng: np.random.Generator | None = None) -> Pillars:
        """Pillars of an (N, 4) scan on this detector's grid, see `pillarize`."""
        return pillarize(points, self.grid, self.limits, rng)

    def decode(self, maps: HeadMaps[NDArray[np.float32]], cells: NDArray[np.integer[Any]] | None = None) -> Detections:
        """Detections in this detector's head maps, or in rows of these head cells, see `decode`."""
        return decode(maps, self.anchors, self.classes, self.post, cells)
