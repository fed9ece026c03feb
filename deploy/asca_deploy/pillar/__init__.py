"""The runtime of pillar detectors."""
