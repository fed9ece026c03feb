"""What holds for every test."""

from hypothesis import settings

# How long an example takes depends on what else the machine does, and says nothing about whether it is right.
settings.register_profile("untimed", deadline=None)
settings.load_profile("untimed")
