"""What every other package builds on: errors, files, processes, settings."""
