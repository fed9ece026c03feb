"""What another process gets of an object."""

from multiprocessing import Pipe
from typing import TypeVar

T = TypeVar("T")


def sent(value: T) -> T:
    """A small value as it comes out of a pipe between processes."""
    give, take = Pipe()
    with give, take:
        give.send(value)
        received: T = take.recv()
    return received
