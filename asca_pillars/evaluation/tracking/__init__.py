"""Identities over time: HOTA and the CLEAR metrics."""
