"""Bundles that only tests read: small trained detectors with a dense neck, and a PV-RCNN."""

from pathlib import Path

_BUNDLES = Path(__file__).parents[1] / "bundles"
DENSE_FLOAT32 = _BUNDLES / "dense_float32"
DENSE_INT8 = _BUNDLES / "dense_int8"
PV_RCNN = _BUNDLES / "pv_rcnn"
