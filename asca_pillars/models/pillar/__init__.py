"""The network of the pillar family and its loss, in PyTorch."""
