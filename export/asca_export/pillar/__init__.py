"""Export of pillar detectors."""
