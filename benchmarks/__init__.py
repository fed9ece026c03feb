"""Commands that measure this project; a package, or the `benchmarks` that pyarrow 17 installs would hide them."""
