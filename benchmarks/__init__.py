"""Benchmarks of this project; a package, since the `benchmarks` installed by pyarrow 17 would hide plain modules."""
