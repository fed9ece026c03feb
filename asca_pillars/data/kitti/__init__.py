"""KITTI's layout, calibrations and labels."""

from asca_pillars.data.kitti.calibration import (
    DEFAULT_IMAGE_SIZE_WH,
    Calibration,
    calibration_of_scan,
    image_boxes,
    in_image,
    read_calibration,
    write_calibration,
)
from asca_pillars.data.kitti.kitti_labels import (
    KittiObject,
    boxes_from_objects,
    is_detection_text,
    labels_text,
    objects_3d,
    objects_from_boxes,
    parse_object,
    read_labels,
    write_labels,
)
from asca_pillars.data.kitti.kitti_split import KittiSplit, write_image_set

__all__ = [
    "DEFAULT_IMAGE_SIZE_WH",
    "Calibration",
    "KittiObject",
    "KittiSplit",
    "boxes_from_objects",
    "calibration_of_scan",
    "image_boxes",
    "in_image",
    "is_detection_text",
    "labels_text",
    "objects_3d",
    "objects_from_boxes",
    "parse_object",
    "read_calibration",
    "read_labels",
    "write_calibration",
    "write_image_set",
    "write_labels",
]
