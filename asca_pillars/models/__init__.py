"""Building a network from its configuration, and its checkpoints."""
