"""Operations on points, pillars, voxels and proposals in NumPy and numba, without PyTorch."""
