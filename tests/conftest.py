"""What holds for every test."""

import logging
from collections.abc import Iterator

import pytest
from hypothesis import settings

# How long an example takes depends on what else the machine does, and says nothing about whether it is right.
settings.register_profile("untimed", deadline=None)
settings.load_profile("untimed")


@pytest.fixture(autouse=True)
def runtime_log_level() -> Iterator[None]:
    """`asca eval` silences the runtime's log for the rest of its process, which here goes on with other tests."""
    log = logging.getLogger("asca_deploy")
    before = log.level
    yield
    log.setLevel(before)
