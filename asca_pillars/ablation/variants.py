"""Rows of the ablations: variants of pillar detectors (the paper's Table 5) and of two-stage detectors."""

import json
from collections.abc import Mapping
from dataclasses import astuple, dataclass, replace
from typing import Any, NamedTuple, Protocol

from asca_pillars.base.schema import to_dict
from asca_pillars.config.pillar import PillarModel
from asca_pillars.config.pv_rcnn import Attention, Gate, PvRcnnModel
from asca_pillars.detection.anchors import KITTI_CLASSES
from asca_pillars.ops.pv_rcnn.prepare import Deform


class Row(Protocol):
    """Interface of a variant: its changes to the base configuration."""

    @property
    def name(self) -> str:
        """Name of the variant."""

    @property
    def overrides(self) -> tuple[str, ...]:
        """Settings for `asca train -s`."""

    @property
    def components(self) -> tuple[str, ...]:
        """Cells of the table's first columns."""

    def base_mismatch(self, model: Any) -> str | None:
        """Reason why the row would change more of a base's `model` than its cells show; None if it would not."""


class Family(NamedTuple):
    """The ablation of one family of detectors."""

    variants: Mapping[str, Row]
    """Variants by name, the baseline first."""
    tables: Mapping[str, tuple[str, ...]]
    """Names of the rows of each table, by its title."""
    components: tuple[str, ...]
    """Headings of the columns of components."""


_FINE_M = 0.08
_SIZES = 5  # first fields of a class: name, sizes and height, which do not depend on thresholds


@dataclass(frozen=True)
class Variant:
    """One row of the pillar detectors' ablation."""

    name: str
    zones: int = 1
    cpa: str = "none"
    insert: str = "none"
    map: str = "warped"
    neck: str = "dense"
    active_cells: str = "fine"
    person_ious: tuple[float, float] | None = None
    """Overlap from which an anchor is positive and below which it is negative, of every class but cars; None for the
    base configuration's."""
    assigner: str | None = None
    """Assigner of anchors to boxes, see `model.loss`; None for the base configuration's."""
    score_target: str | None = None
    """Target of the scores, see `model.loss`; None for the base configuration's."""
    fine_pillars: bool = False
    """Pillars of 0.08 m, which make cells of the head as small as pillars are otherwise; of one zone."""

    @property
    def overrides(self) -> tuple[str, ...]:
        """Overrides for `asca train -s`. One zone has PointPillars' pillars of 0.16 m, several begin with 0.32 m."""
        along_m = _FINE_M if self.fine_pillars else 0.16 if self.zones == 1 else 0.32
        return (
            f"model.spec.grid.map={self.map}",
            f"model.network.neck={self.neck}",
            f"model.network.active_cells={self.active_cells}",
            *self._loss_settings,
            f"model.spec.grid.zones={self.zones}",
            f"model.spec.grid.v_max_m={along_m}",
            *((f"model.spec.grid.v_y_m={_FINE_M}",) if self.fine_pillars else ()),
            f"model.network.cpa={self.cpa}",
            f"augment.insert.method={self.insert}",
        )

    @property
    def components(self) -> tuple[str, ...]:
        """Cells of the table's first columns, see `PILLARS`."""
        zones = f"K={self.zones}" if self.zones > 1 else f"{_FINE_M:g} m" if self.fine_pillars else "-"
        if self.map != "warped":
            zones += f" {self.map}"
        cpa = "-" if self.cpa == "none" else self.cpa
        neck = "-" if self.neck == "dense" else self.active_cells
        insert = {"none": "-", "gt_aug": "GT-Aug", "rs_aug": "RS-Aug"}[self.insert]
        matching = self.assigner or "-"
        if self.person_ious is not None:
            matching = " / ".join(f"{iou:g}" for iou in self.person_ious)
        return zones, cpa, insert, neck, matching, self.score_target or "-"

    def base_mismatch(self, model: PillarModel) -> str | None:
        """Return why the base does not fit: a row with other thresholds states all classes."""
        sizes = [[astuple(spec)[:_SIZES] for spec in classes] for classes in (KITTI_CLASSES, model.spec.classes)]
        return "states KITTI's classes" if self.person_ious is not None and sizes[0] != sizes[1] else None

    @property
    def _loss_settings(self) -> tuple[str, ...]:
        """Settings of the loss that this variant changes."""
        choices = {"assigner": self.assigner, "score_target": self.score_target}
        chosen = tuple(f"model.loss.{name}={choice}" for name, choice in choices.items() if choice is not None)
        if self.person_ious is None:
            return chosen
        positive, negative = self.person_ious
        classes = [
            spec if spec.name == "Car" else replace(spec, positive_iou=positive, negative_iou=negative)
            for spec in KITTI_CLASSES
        ]
        return (*chosen, f"model.spec.classes={json.dumps([to_dict(spec) for spec in classes])}")


VARIANTS = {
    variant.name: variant
    for variant in (
        Variant("baseline"),
        Variant("asp_k3", zones=3),
        Variant("cpa_channel", cpa="channel"),
        Variant("cpa_linear", cpa="linear"),
        Variant("asp_k3_cpa_channel", zones=3, cpa="channel"),
        Variant("asp_k2", zones=2),
        Variant("asp_k4", zones=4),
        Variant("asp_k3_cpa_paper", zones=3, cpa="paper"),
        Variant("gt_aug", insert="gt_aug"),
        Variant("rs_aug", insert="rs_aug"),
        Variant("asp_k3_cpa_channel_rs_aug", zones=3, cpa="channel", insert="rs_aug"),
        Variant("asp_k3_cpa_point", zones=3, cpa="point"),
        Variant("asp_k3_pooled_cpa_channel", zones=3, cpa="channel", map="pooled"),
        Variant("cpa_channel_sub", cpa="channel", neck="sparse", active_cells="sub"),
        Variant("cpa_channel_fine", cpa="channel", neck="sparse"),
        Variant("asp_k3_cpa_channel_fine", zones=3, cpa="channel", neck="sparse"),
        Variant("asp_k3_pooled_cpa_channel_fine", zones=3, cpa="channel", map="pooled", neck="sparse"),
        Variant("cpa_channel_lower_ious", cpa="channel", person_ious=(0.35, 0.2)),
        Variant("cpa_channel_fine_lower_ious", cpa="channel", neck="sparse", person_ious=(0.35, 0.2)),
        Variant("cpa_linear_fine_lower_ious", cpa="linear", neck="sparse", person_ious=(0.35, 0.2)),
        Variant(
            "asp_k3_pooled_cpa_channel_fine_lower_ious",
            zones=3,
            cpa="channel",
            map="pooled",
            neck="sparse",
            person_ious=(0.35, 0.2),
        ),
        Variant(
            "fine_pillars_cpa_channel_fine_lower_ious",
            cpa="channel",
            neck="sparse",
            person_ious=(0.35, 0.2),
            fine_pillars=True,
        ),
        Variant("cpa_channel_fine_atss", cpa="channel", neck="sparse", assigner="atss"),
        Variant("cpa_channel_fine_iou_score", cpa="channel", neck="sparse", score_target="iou"),
        Variant("cpa_channel_fine_atss_iou_score", cpa="channel", neck="sparse", assigner="atss", score_target="iou"),
    )
}

PILLARS = Family(
    variants=VARIANTS,
    tables={
        "Components (the rows of the paper's Table 5)": (
            *("baseline", "gt_aug", "rs_aug", "asp_k3", "cpa_channel", "asp_k3_cpa_channel"),
            "asp_k3_cpa_channel_rs_aug",
        ),
        "Zones of the adaptive-scale pillars (K)": ("baseline", "asp_k2", "asp_k3", "asp_k4"),
        "Readings of the correlative point attention": (
            *("asp_k3", "asp_k3_cpa_paper", "asp_k3_cpa_channel", "asp_k3_cpa_point"),
        ),
        "Channel attention, and a linear layer that is the same for every frame": (
            *("baseline", "cpa_linear", "cpa_channel", "cpa_linear_fine_lower_ious", "cpa_channel_fine_lower_ious"),
        ),
        "Map and neck": (
            *("cpa_channel", "asp_k3_cpa_channel", "asp_k3_pooled_cpa_channel"),
            *("cpa_channel_sub", "cpa_channel_fine", "asp_k3_cpa_channel_fine", "asp_k3_pooled_cpa_channel_fine"),
            *("cpa_channel_fine_lower_ious", "asp_k3_pooled_cpa_channel_fine_lower_ious"),
            "fine_pillars_cpa_channel_fine_lower_ious",
        ),
        "Matching, and what scores are to be": (
            *("cpa_channel", "cpa_channel_lower_ious", "cpa_channel_fine", "cpa_channel_fine_lower_ious"),
            *("cpa_channel_fine_atss", "cpa_channel_fine_iou_score", "cpa_channel_fine_atss_iou_score"),
        ),
    },
    components=("ASP", "CPA", "Aug", "neck", "matching", "score"),
)


BASE = "ablation_two_stage"
"""The configuration that ships for these rows; MSAA's row repeats its sources without the points."""
_KEYPOINTS = 512
_VECTOR_CELLS = 3
_SCALES_M, _SCALE_WIDTHS = (0.8, 1.6, 3.2), (16, 32, 32)

_SOURCES: list[dict[str, Any]] = [
    {"source": "conv2", "radii_m": [0.8, 1.2], "samples": [16, 16]},
    {"source": "conv3", "radii_m": [1.2, 2.4], "samples": [16, 16]},
    {"source": "conv4", "radii_m": [2.4, 4.8], "samples": [16, 16]},
]


@dataclass(frozen=True)
class TwoStageVariant:
    """One row: what it changes in a base of kind pv_rcnn."""

    name: str
    deform: Deform = "none"
    gate: Gate = "none"
    vector: bool = False
    attention: Attention = "none"
    scales: bool = False
    box_loss: str = "smooth_l1"
    keypoints: int = _KEYPOINTS

    @property
    def overrides(self) -> tuple[str, ...]:
        """Settings for `asca train -s`."""
        return (
            f"model.settings.deform={self.deform}",
            f"model.network.gate={self.gate}",
            f"model.settings.vector_cells={_VECTOR_CELLS if self.vector else 0}",
            f"model.network.attention={self.attention}",
            f"model.box_loss={self.box_loss}",
            f"model.settings.keypoints={self.keypoints}",
            *(self._scales if self.scales else ()),
        )

    def base_mismatch(self, model: PvRcnnModel) -> str | None:
        """Return why the base does not fit: its sources are other than those that the row states."""
        sources = [to_dict(source) for source in model.settings.sources]
        if not sources or sources[0]["source"] != "points":
            return "has balls of raw points, which the base has not"
        others = sources[1:]
        return "states other sources than the base has" if self.scales and others != _SOURCES else None

    @property
    def _scales(self) -> tuple[str, ...]:
        """Overrides of a row with MSAA, which takes the place of the balls of raw points."""
        return (
            f"model.settings.sources={json.dumps(_SOURCES)}",
            f"model.network.source_widths={json.dumps([[16, 16], [32, 32], [32, 32]])}",
            f"model.settings.scale_radii_m={json.dumps(_SCALES_M)}",
            f"model.network.scale_widths={json.dumps(_SCALE_WIDTHS)}",
            "model.network.scale_channels=32",
        )

    @property
    def components(self) -> tuple[str, ...]:
        """Cells of the table's first columns, see `TWO_STAGE`."""
        return (
            _dash_if_empty(self.deform),
            "yes" if self.gate != "none" else "-",
            "VectorPool" if self.vector else "balls",
            _dash_if_empty(self.attention),
            "MSAA" if self.scales else "balls",
            "VA" if self.box_loss == "va" else "-",
            str(self.keypoints),
        )


def _dash_if_empty(value: str) -> str:
    return "-" if value == "none" else value


_ROWS = (
    TwoStageVariant("pv_rcnn"),
    TwoStageVariant("deform_paper", deform="paper"),
    TwoStageVariant("deform_authors", deform="authors"),
    TwoStageVariant("deform_authors_frozen", deform="authors_frozen"),
    TwoStageVariant("gate", gate="keypoint"),
    TwoStageVariant("vector_pool", vector=True),
    TwoStageVariant("deform_gate", deform="paper", gate="keypoint"),
    TwoStageVariant("deform_vector_pool", deform="paper", vector=True),
    TwoStageVariant("gate_vector_pool", gate="keypoint", vector=True),
    TwoStageVariant("deform_gate_vector_pool", deform="paper", gate="keypoint", vector=True),
    TwoStageVariant("dual_attention", attention="dual"),
    TwoStageVariant("rda", attention="rda"),
    TwoStageVariant("msaa", scales=True),
    TwoStageVariant("va", box_loss="va"),
    TwoStageVariant("rda_msaa", attention="rda", scales=True),
    TwoStageVariant("rda_msaa_va", attention="rda", scales=True, box_loss="va"),
    TwoStageVariant("keypoints_256", keypoints=256),
    TwoStageVariant("keypoints_256_deform", keypoints=256, deform="paper"),
    TwoStageVariant("keypoints_1024", keypoints=1024),
    TwoStageVariant("keypoints_1024_deform", keypoints=1024, deform="paper"),
    TwoStageVariant("keypoints_2048", keypoints=2048),
    TwoStageVariant("keypoints_2048_deform", keypoints=2048, deform="paper"),
)

TWO_STAGE = Family(
    variants={row.name: row for row in _ROWS},
    tables={
        "Adaptive deformation (Deformable PV-RCNN)": (
            *("pv_rcnn", "deform_paper", "deform_authors", "deform_authors_frozen"),
        ),
        "Deformation, context fusion and VectorPool (AV PV-RCNN, Tables 5 and 6)": (
            *("pv_rcnn", "deform_paper", "gate", "vector_pool", "deform_gate", "deform_vector_pool"),
            *("gate_vector_pool", "deform_gate_vector_pool"),
        ),
        "Dual attention, features of raw points and loss (AFE-RCNN, Tables 4 and 5)": (
            *("pv_rcnn", "dual_attention", "rda", "msaa", "va", "rda_msaa", "rda_msaa_va"),
        ),
        "Keypoints (figure 4 of Deformable PV-RCNN)": (
            *("keypoints_256", "keypoints_256_deform", "pv_rcnn", "deform_paper"),
            *("keypoints_1024", "keypoints_1024_deform", "keypoints_2048", "keypoints_2048_deform"),
        ),
    },
    components=("deformation", "gate", "RoI pooling", "attention", "raw points", "box loss", "keypoints"),
)
