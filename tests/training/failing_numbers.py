"""A dataset whose loader process fails; it imports little, because each process imports it."""

import os
import signal
import time
from dataclasses import dataclass
from typing import Any


class Unsendable:
    def __reduce__(self) -> Any:
        raise RuntimeError("unable to allocate shared memory(shm)")


@dataclass(frozen=True)
class Numbers:
    """Gives its indices, and does `what` at the fourth."""

    what: str = ""

    def __len__(self) -> int:
        return 12

    def __getitem__(self, index: int) -> Any:
        if index == 4 and self.what == "unsendable":
            return Unsendable()
        if self.what == "slow":
            time.sleep(1 if index == 4 else 0)
        elif index == 4 and self.what:
            os.kill(os.getpid(), getattr(signal, self.what))
        return index
