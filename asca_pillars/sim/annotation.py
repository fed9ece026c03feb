"""KITTI labels of a simulated scan: what the camera sees, how much of it, and what is only DontCare."""

from dataclasses import replace

import numpy as np

from asca_pillars.data.kitti import Calibration, KittiObject, image_boxes, in_image, objects_from_boxes
from asca_pillars.sim.casting.raycast import Hits
from asca_pillars.sim.scene_config import SceneConfig
from asca_pillars.sim.sensor.returns import Returns
from asca_pillars.sim.world.placement import Target

# Visible share of the firings that would meet the object alone, above which KITTI's annotators would say
# "fully visible" (0), "partly occluded" (1) and "largely occluded" (2); below the last it is "unknown" (3).
# The steps give simulated cars the shares of KITTI's: 47, 28, 21 and 3 %.
OCCLUSION_STEPS = (0.82, 0.36, 0.09)
MAX_TRUNCATION = 0.95
UNKNOWN_FROM_TRUNCATION = 0.85  # what hardly stands in the image, KITTI mostly marks as unknown, too


def make_labels(
    targets: tuple[Target, ...], hits: Hits, returns: Returns, calib: Calibration, config: SceneConfig
) -> list[KittiObject]:
    """Labels of the objects that the camera sees, nearest first; DontCare areas last.

    An object is DontCare if too few of its points lie in the image or too little of it is visible, and is left out
    if nothing of it is visible or it lies outside the image.
    """
    if not targets:
        return []
    boxes = np.array([target.box for target in targets])
    _, truncated = image_boxes(boxes, calib)
    owned = returns.owner >= 0
    seen = in_image(returns.points[owned], calib)
    points = np.bincount(returns.owner[owned][seen], minlength=len(targets))
    visible = hits.visible / np.maximum(hits.alone, 1)
    objects = objects_from_boxes(boxes, [target.type for target in targets], calib)
    labels, areas = [], []
    for index in np.argsort(np.hypot(boxes[:, 0], boxes[:, 1]), kind="stable"):
        if truncated[index] >= MAX_TRUNCATION or hits.visible[index] == 0:
            continue
        item = objects[index]
        if points[index] < config.min_points or visible[index] < config.min_visible_share:
            areas.append(dont_care(item.bbox))
            continue
        occluded = int(np.searchsorted(-np.array(OCCLUSION_STEPS), -visible[index], side="right"))
        if truncated[index] > UNKNOWN_FROM_TRUNCATION:
            occluded = len(OCCLUSION_STEPS)
        labels.append(replace(item, truncated=round(float(truncated[index]), 2), occluded=occluded))
    return labels + areas


def dont_care(bbox: tuple[float, float, float, float]) -> KittiObject:
    """An area of the image in which detections count neither as right nor as wrong."""
    return KittiObject("DontCare", -1, -1, -10, bbox, -1, -1, -1, -1000, -1000, -1000, -10)
