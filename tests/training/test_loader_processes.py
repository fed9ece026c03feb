"""What a process that loads batches finds imported when it starts."""

import sys
from multiprocessing.connection import Connection

from asca_pillars.training.loader_processes import loader_context


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
