"""A first stage's proposals, kept on disk, and the samples and the training of the second stage that refines them."""
