"""What the pillar family adds to `geometry`, in NumPy: grid, pillarize, `PillarSpec`."""
