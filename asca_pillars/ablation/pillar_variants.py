"""Rows of the pillar detectors' ablation: the paper's Table 5, zones and maps, readings of CPA, necks, matching."""

import json
from dataclasses import astuple, dataclass, replace

from asca_pillars.ablation.family import Family
from asca_pillars.base.schema import to_dict
from asca_pillars.config.pillar import PillarModel
from asca_pillars.detection.anchors import KITTI_CLASSES

_FINE_M = 0.08
_SIZES = 5  # of a class, the first fields: name, sizes and height, which thresholds do not change


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
    """What matches anchors with boxes, see `model.loss`; None for the base configuration's."""
    score_target: str | None = None
    """What scores are to be, likewise."""
    fine_pillars: bool = False
    """Pillars of 0.08 m, which make cells of the head as small as pillars are otherwise; of one zone."""

    @property
    def overrides(self) -> tuple[str, ...]:
        """For `asca train -s`. One zone means PointPillars' pillars of 0.16 m, several start at the paper's 0.32 m."""
        along_m = _FINE_M if self.fine_pillars else 0.16 if self.zones == 1 else 0.32
        return (
            f"model.spec.grid.map={self.map}",
            f"model.network.neck={self.neck}",
            f"model.network.active_cells={self.active_cells}",
            *self._learnt,
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

    def misfit(self, model: PillarModel) -> str | None:
        """Rows with other thresholds state all classes."""
        sizes = [[astuple(one)[:_SIZES] for one in classes] for classes in (KITTI_CLASSES, model.spec.classes)]
        return "states KITTI's classes" if self.person_ious is not None and sizes[0] != sizes[1] else None

    @property
    def _learnt(self) -> tuple[str, ...]:
        """Which anchors learn, and what."""
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
