"""Dataset, sampler and the training loop on Lightning."""
