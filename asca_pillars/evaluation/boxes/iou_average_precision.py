"""Average precision of any class by IoU, in 3D and from above (BEV), without a camera.

Detections take objects as `box_pairs` says; a match needs an IoU of at least the threshold. AP is the area under
precision over recall, precision at a recall being the best at that recall or beyond (Everingham et al., "The Pascal
Visual Object Classes Challenge: A Retrospective", IJCV 2015, all points). A detection that matches nothing but overlaps
an object that does not count, by the threshold, is neither right nor wrong.

A band keeps the objects in it, the detections that match them, and the unmatched detections that stand in it.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from asca_pillars.evaluation.boxes.bands import BANDS, in_band
from asca_pillars.evaluation.boxes.box_pairs import UNMATCHED, BoxPairs, EvaluatedFrame, pair_class
from asca_pillars.geometry.overlap import bev_iou, iou_3d

Metric = Literal["3d", "bev"]

IOUS = (0.3, 0.5, 0.7)
_CLOSENESS = {"3d": iou_3d, "bev": bev_iou}


@dataclass(frozen=True)
class IouScore:
    """AP of one class in percent; None where there is no object."""

    class_name: str
    metric: Metric
    min_iou: float
    band: str
    objects: int
    ap: float | None


def iou_scores(frames: Sequence[EvaluatedFrame], class_names: Sequence[str]) -> list[IouScore]:
    """AP for every class, metric, IoU and band, in that order."""
    scores = []
    for name in class_names:
        metrics: tuple[Metric, ...] = ("3d", "bev")
        for metric in metrics:
            pairs = pair_class(frames, name, _CLOSENESS[metric])
            for least in IOUS:
                matched = match_by_iou(pairs, least)
                for band in BANDS:
                    counted, hits, objects = in_band(pairs, matched, band)
                    counted &= (matched != UNMATCHED) | (pairs.excuse < least)
                    ap = area_under_curve(hits[counted], objects)
                    scores.append(IouScore(name, metric, least, band, objects, ap))
    return scores


def match_by_iou(pairs: BoxPairs, least: float) -> NDArray[np.int64]:
    """(N,) the object that each detection takes by an IoU of at least `least`, or UNMATCHED."""
    return pairs.match(lambda overlap: overlap >= least)


def area_under_curve(hits: NDArray[np.bool_], objects: int) -> float | None:
    """Percent, from the detections (N,) by descending score; None without objects."""
    if not objects:
        return None
    precision = np.cumsum(hits) / np.arange(1, len(hits) + 1)
    best = np.maximum.accumulate(precision[::-1])[::-1]
    return float(100 * best[hits].sum() / objects)
