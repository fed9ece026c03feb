"""What another process gets of an object."""

from multiprocessing import Pipe
from threading import Thread
from typing import TypeVar

T = TypeVar("T")


def sent(value: T) -> T:
    """A value as it comes out of a pipe between processes."""
    give, take = Pipe()
    with give, take:
        sender = Thread(target=give.send, args=(value,))  # a pipe holds little
        sender.start()
        received: T = take.recv()
        sender.join()
    return received
