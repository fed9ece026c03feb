"""Export of the second stage."""
