"""Short drives: the same street scan by scan, with moving car and road users."""
