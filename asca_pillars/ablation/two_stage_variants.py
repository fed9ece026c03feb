"""Rows of the two-stage ablation: what three papers add to PV-RCNN, alone and together, and fewer keypoints."""

import json
from dataclasses import dataclass
from typing import Any

from asca_pillars.ablation.family import Family
from asca_pillars.base.schema import to_dict
from asca_pillars.config.pv_rcnn import Attention, Gate, PvRcnnModel
from asca_pillars.ops.pv_rcnn.prepare import Deform

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
        """For `asca train -s`."""
        return (
            f"model.settings.deform={self.deform}",
            f"model.network.gate={self.gate}",
            f"model.settings.vector_cells={_VECTOR_CELLS if self.vector else 0}",
            f"model.network.attention={self.attention}",
            f"model.box_loss={self.box_loss}",
            f"model.settings.keypoints={self.keypoints}",
            *(self._scales if self.scales else ()),
        )

    def misfit(self, model: PvRcnnModel) -> str | None:
        """Rows with MSAA state all sources, and those without have the balls of raw points."""
        sources = [to_dict(one) for one in model.settings.sources]
        if not sources or sources[0]["source"] != "points":
            return "has balls of raw points, which the base has not"
        others = sources[1:]
        return "states other sources than the base has" if self.scales and others != _SOURCES else None

    @property
    def _scales(self) -> tuple[str, ...]:
        """MSAA takes the place of the balls of raw points."""
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
            _or_dash(self.deform),
            "yes" if self.gate != "none" else "-",
            "VectorPool" if self.vector else "balls",
            _or_dash(self.attention),
            "MSAA" if self.scales else "balls",
            "VA" if self.box_loss == "va" else "-",
            str(self.keypoints),
        )


def _or_dash(value: str) -> str:
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
