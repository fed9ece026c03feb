"""The runtime of PV-RCNN."""
