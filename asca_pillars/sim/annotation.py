"""KITTI labels of a simulated scan: of the camera's field of view, or of every direction.

Labels of every direction (`label_all_around`) are KITTI's text with these meanings where there is no camera:

    box 2D      -1 -1 -1 -1 for an object beside the image or behind the camera
    truncated   -1 (unknown) for such an object: no image border truncates it
    occluded    0..3 by the share of the firings that reach the object, in any direction
    alpha       the heading relative to the line of sight, as for any object: it needs no image

There are no DontCare areas: objects with hardly any returns are occluded 3. The set's simulation.json states
"field_of_view": "around". KITTI's protocol ignores objects without a 2D box, for their lack of height in the image.
"""

from dataclasses import replace

import numpy as np
import numpy.typing as npt

from asca_pillars.data.kitti import Calibration, KittiObject, image_boxes, objects_from_boxes
from asca_pillars.sim.casting.raycast import Hits
from asca_pillars.sim.scene_config import SceneConfig
from asca_pillars.sim.world.placement import Target

# Visible fraction of the firings that would hit the object alone, above which an object is
# "fully visible" (0), "partly occluded" (1) and "largely occluded" (2); below the last it is "unknown" (3).
# With these steps simulated cars have the shares of KITTI's: 47, 28, 21 and 3 %.
OCCLUSION_STEPS = (0.82, 0.36, 0.09)
UNKNOWN = len(OCCLUSION_STEPS)
MAX_TRUNCATION = 0.95
UNKNOWN_FROM_TRUNCATION = 0.85  # KITTI mostly marks objects largely outside the image as unknown, too

Owners = npt.NDArray[np.int32]


def label_camera_view(
    targets: tuple[Target, ...], hits: Hits, owner: Owners, calib: Calibration, config: SceneConfig
) -> list[KittiObject]:
    """Return the labels of the objects that the camera sees, nearest first; DontCare areas last.

    An object is DontCare if too few of its points are in the image or too little of it is visible, and is left out
    if none of it is visible or it is outside the image.

    Args:
        targets: the objects (M).
        hits: number of their occluded firings.
        owner: (N,) object index, or negative, of each point in the image.
        calib: the camera.
        config: least number of points and visible fraction of a labelled object.
    """
    points, visible = evidence(hits, owner)
    _, truncated = image_boxes(_boxes(targets), calib)
    labels, areas = [], []
    objects = _objects(targets, calib)
    for index in nearest_first(targets):
        if truncated[index] >= MAX_TRUNCATION or hits.visible[index] == 0:
            continue
        item = objects[index]
        if points[index] < config.min_points or visible[index] < config.min_visible_share:
            areas.append(dont_care(item.bbox))
            continue
        unknown = truncated[index] > UNKNOWN_FROM_TRUNCATION
        occluded = UNKNOWN if unknown else occlusion_state(visible[index])
        labels.append(replace(item, truncated=round(float(truncated[index]), 2), occluded=occluded))
    return labels + areas


def label_all_around(
    targets: tuple[Target, ...], hits: Hits, owner: Owners, calib: Calibration, config: SceneConfig
) -> list[KittiObject]:
    """Return the labels of all objects with a return, nearest first.

    Arguments are as for `label_camera_view`, but `owner` (N,) is of all points. See the module docstring for the
    meaning of the fields without a camera.
    """
    points, visible = evidence(hits, owner)
    _, truncated = image_boxes(_boxes(targets), calib)
    labels = []
    objects = _objects(targets, calib)
    for index in nearest_first(targets):
        if points[index] == 0:
            continue
        item = objects[index]
        occluded = occlusion_around(points[index], visible[index], config)
        in_image = item.bbox[2] > item.bbox[0]
        cut = round(float(truncated[index]), 2) if in_image else -1.0
        labels.append(replace(item, truncated=cut, occluded=occluded))
    return labels


def occlusion_around(points: int, visible_share: float, config: SceneConfig) -> int:
    """Return the occlusion state 0..3 of an object by its number of points and visible fraction."""
    hardly = points < config.min_points or visible_share < config.min_visible_share
    return UNKNOWN if hardly else occlusion_state(visible_share)


def occlusion_state(visible_share: float) -> int:
    """Return KITTI's occlusion state 0..3 of an object by its visible fraction."""
    return sum(step >= float(visible_share) for step in OCCLUSION_STEPS)


def dont_care(bbox: tuple[float, float, float, float]) -> KittiObject:
    """Return an area of the image in which detections are ignored."""
    return KittiObject("DontCare", -1, -1, -10, bbox, -1, -1, -1, -1000, -1000, -1000, -10)


def _boxes(targets: tuple[Target, ...]) -> npt.NDArray[np.float64]:
    return np.array([target.box for target in targets], float).reshape(-1, 7)


def _objects(targets: tuple[Target, ...], calib: Calibration) -> list[KittiObject]:
    return objects_from_boxes(_boxes(targets), [target.type for target in targets], calib)


def nearest_first(targets: tuple[Target, ...]) -> npt.NDArray[np.int64]:
    """Return the indices (M,) of the objects by their distance in metres from the sensor."""
    return np.argsort(np.hypot(*_boxes(targets)[:, :2].T), kind="stable")


def evidence(hits: Hits, owner: Owners) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.float64]]:
    """Return the number of points of each object (M,), by the `owner` (N,) of each point, and its visible fraction."""
    points = np.bincount(owner[owner >= 0], minlength=len(hits.alone))
    return points, hits.visible / np.maximum(hits.alone, 1)
