"""Sparse convolutions as neighbor tables, in 2D and 3D, in NumPy alone.

A convolution that computes only at active cells reads, for each of its M outputs, one row of a table (M, K) int32: the
row of the active input under each of the kernel's K taps, or the number of inputs N where there is none. With a row of
zeros appended to the features, the convolution is then a gather and one matrix product, deterministic for any number
of threads. The tables are built here, for training and on the vehicle; where numba is installed it runs the loops.

In the order of the data: `voxels` -> `cell_map` (active cells and tables, by `convolution`s) -> `neck_tables` for the
neck of the pillar detector, `voxel_tables` for a backbone over voxels -> `batching`.
"""
