"""The configuration: one typed tree, one section for each family of detectors."""
