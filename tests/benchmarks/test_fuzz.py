"""Every reader, and every file that a command resumes from, passes a short fuzz run, which tells bad from good."""

import time
from pathlib import Path

import numpy as np
import pytest

from benchmarks import fuzz
from benchmarks.fuzz_inputs import Kind


def test_damaged_input_is_read_or_refused(tmp_path: Path) -> None:
    counts, failures = fuzz.fuzz(tmp_path, seed=1, inputs=475)
    assert not failures, failures
    assert {outcome for _, outcome in counts} == {"read", "refused"}


def test_every_kind_accepts_its_undamaged_files(tmp_path: Path) -> None:
    for kind in fuzz.kinds(tmp_path):
        for seed in kind.seeds:
            if seed or kind.name in ("labels", "predictions"):
                assert fuzz.read(kind, seed) == ("read", ""), kind.name


def test_bad_outcomes_are_found(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def outcome(result: object) -> str:
        def reader(_: Path) -> object:
            if isinstance(result, Exception):
                raise result
            return time.sleep(1) if isinstance(result, str) else result

        return fuzz.read(Kind("scan", tmp_path / "a.bin", (b"x",), reader, is_scan=True), b"x")[0]

    assert outcome(ValueError()) == "traceback"
    assert outcome(np.array([[np.nan] * 4])) == "not finite"
    assert outcome(np.zeros((100, 4))) == "too many points"
    assert outcome(np.zeros((1, 4))) == "read"
    monkeypatch.setattr(fuzz, "SLOW_S", 0.05)  # of the last one alone: a busy machine may make the others as slow
    assert outcome("sleep") == "slow"


def test_a_file_outside_of_the_target_is_found(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def stray(path: Path) -> int:
        if path.read_bytes() != b"x":  # but not the first time
            (path.parent.parent / "stray").write_bytes(path.read_bytes())
        return 0

    monkeypatch.setattr(fuzz, "kinds", lambda place: [Kind("made up", place / "own" / "a", (b"x",), stray)])
    counts, failures = fuzz.fuzz(tmp_path, 1, inputs=5)
    assert counts["made up", fuzz.LEFT] and "stray" in failures[0]
