"""Training and comparing the variants of the paper's Table 5."""
