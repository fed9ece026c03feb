"""Export of PV-RCNN."""
