"""Import of published datasets into one layout; scans are referenced, not copied."""
