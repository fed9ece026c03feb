"""The second stage of a two-stage detector, in PyTorch."""
