"""The runtime of the second stage."""
