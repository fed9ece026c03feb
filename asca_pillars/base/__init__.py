"""Base of the other packages: errors, files, processes, settings."""
