"""What has been detected in a recording so far: lines that a killed run leaves and the next one goes on from.

The journal holds what detection gave, scan by scan and to the last bit; identities and all files that a user wants are
made of it at the end, in one go and atomically. So they are the same whether the run was killed or not. Its first line
says what the results depend on; a journal of anything else is begun anew. A line that a kill cut in two is dropped.
"""

import json
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from types import TracebackType
from typing import IO, Any, NamedTuple

import numpy as np

from asca_deploy import Detections
from asca_pillars.errors import OutputError
from asca_pillars.locks import try_lock

JOURNAL_FILE = "detections.partial.jsonl"


class ScanResult(NamedTuple):
    """What is known of one message: its number, time and frame, and what was found or why it was skipped."""

    number: int
    time_ns: int
    frame_id: str
    detections: Detections | None
    trouble: str | None = None
    dropped_points: int = 0


class Journal:
    """The journal of a run in `folder`, locked while it is open.

    Attributes:
        done: how many messages it held when it was opened.
        differs: what another run that left one here had otherwise, the first key; None if there was none.

    Raises:
        OutputError: when the block is entered, if another process writes it.
    """

    def __init__(self, folder: Path, about: dict[str, Any], class_names: tuple[str, ...]) -> None:
        self.path, self._about, self._class_names = folder / JOURNAL_FILE, about, class_names
        self._file: IO[bytes]
        self.done = 0
        self.differs: str | None = None

    def __enter__(self) -> "Journal":
        self.path.parent.mkdir(parents=True, exist_ok=True)
        self._file = self.path.open("a+b")
        if not try_lock(self._file.fileno()):
            self._file.close()
            raise OutputError(f"{self.path}: another run writes it; wait for it, or choose another --out")
        kept = self._whole_lines()
        self._file.truncate(kept)
        if kept == 0:
            self._append(self._about)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._file.close()

    def add(self, result: ScanResult) -> None:
        """Append a scan's result; it outlives a kill from here on."""
        found = result.detections
        line: dict[str, Any] = {"number": result.number, "time_ns": result.time_ns, "frame_id": result.frame_id}
        if found is None:
            line["trouble"] = result.trouble
        else:
            line |= {"boxes": found.boxes.tolist(), "scores": found.scores.tolist(), "labels": found.labels.tolist()}
            line["dropped_points"] = result.dropped_points
        self._append(line)

    def results(self) -> Iterator[ScanResult]:
        """All results, in the order of the messages."""
        with self.path.open("rb") as file:
            next(file)
            for line in file:
                yield self._result(json.loads(line))

    def remove(self) -> None:
        """Done: what it was for has been written."""
        self.path.unlink()

    def _append(self, line: dict[str, Any]) -> None:
        self._file.write(json.dumps(line).encode() + b"\n")
        self._file.flush()

    def _whole_lines(self) -> int:
        """Bytes of the lines that are whole and of this run; counts them."""
        self._file.seek(0)
        kept = 0
        for number, line in enumerate(self._file):
            content = None
            with suppress(ValueError):
                content = json.loads(line) if line.endswith(b"\n") else None
            about = json.loads(json.dumps(self._about))
            if number == 0 and content != about:
                before = content if isinstance(content, dict) else {}
                self.differs = next((key for key in about if before.get(key) != about[key]), "its content")
                return 0
            if number > 0 and (not isinstance(content, dict) or content.get("number") != number - 1):
                break
            kept += len(line)
            self.done = number
        return kept

    def _result(self, line: dict[str, Any]) -> ScanResult:
        place = line["number"], line["time_ns"], line["frame_id"]
        if "trouble" in line:
            return ScanResult(*place, None, line["trouble"])
        boxes = np.array(line["boxes"], np.float32).reshape(-1, 7)
        scores, labels = np.array(line["scores"], np.float32), np.array(line["labels"], np.int64)
        return ScanResult(
            *place, Detections(boxes, scores, labels, self._class_names), dropped_points=line["dropped_points"]
        )
