"""What a process that loads batches finds imported when it starts."""

import os
import signal
import sys
from multiprocessing.connection import Connection

from asca_pillars.training.shared_batches import ignore_interrupts, loader_context


def tell(connection: Connection) -> None:
    connection.send({name: name in sys.modules for name in ("asca_pillars.training.dataset", "lightning")})


def test_a_process_starts_with_what_it_needs_and_without_the_loop() -> None:
    context = loader_context()
    here, there = context.Pipe()
    process = context.Process(target=tell, args=(there,))
    process.start()
    assert here.recv() == {"asca_pillars.training.dataset": True, "lightning": False}
    process.join()
    here.close()
    there.close()


def answer(connection: Connection) -> None:
    ignore_interrupts()
    connection.send("ready")
    while connection.recv() is None:
        connection.send("still here")


def test_it_outlives_the_first_sigterm_of_its_job() -> None:
    """As Ctrl-C, which reaches every process of a terminal; the second one is the loader's own."""
    context = loader_context()
    here, there = context.Pipe()
    process = context.Process(target=answer, args=(there,))
    process.start()
    assert here.poll(30) and here.recv() == "ready" and process.pid is not None
    for number in (signal.SIGINT, signal.SIGTERM):
        os.kill(process.pid, number)
        here.send(None)
        assert here.poll(30) and here.recv() == "still here"
    process.terminate()
    process.join(30)
    assert process.exitcode == -signal.SIGTERM
    here.close()
    there.close()
