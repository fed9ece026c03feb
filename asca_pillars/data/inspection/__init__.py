"""Inspection of a dataset: its contents, and its fit to a configuration."""
