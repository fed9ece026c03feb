"""Sparse convolutions by rulebooks, in 2D and 3D.

A convolution that computes only at active cells reads, for each of its M outputs, one row of a rulebook (M, K) int32:
the row of the active input under each of the kernel's K taps, or the number of inputs N where there is none. With a row
of zeros appended to the features, the convolution is then a gather and one matrix product, deterministic for any number
of threads. Rulebooks are built here, for training and on the vehicle.
"""
