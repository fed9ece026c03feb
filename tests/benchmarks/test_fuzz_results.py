"""A short run over what commands go on from, and that undamaged files are gone on from."""

from pathlib import Path

import pytest

from benchmarks import fuzz, fuzz_results
from benchmarks.fuzz_inputs import Kind


def test_what_is_damaged_is_done_again_or_refused(tmp_path: Path) -> None:
    counts, failures = fuzz_results.fuzz_results(tmp_path, 1, inputs=150)
    assert not failures, failures
    assert {outcome for _, outcome in counts} == {"read", "refused"}


def test_every_kind_accepts_its_undamaged_files(tmp_path: Path) -> None:
    for kind in fuzz_results.kinds(tmp_path):
        for seed in kind.seeds:
            if seed or kind.name in ("labels", "predictions"):
                assert fuzz.read(kind, seed) == ("read", ""), kind.name


def test_a_file_outside_of_the_target_is_found(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def stray(path: Path) -> int:
        if path.read_bytes() != b"x":  # but not the first time
            (path.parent.parent / "stray").write_bytes(path.read_bytes())
        return 0

    monkeypatch.setattr(fuzz_results, "kinds", lambda place: [Kind("made up", place / "own" / "a", (b"x",), stray)])
    counts, failures = fuzz_results.fuzz_results(tmp_path, 1, inputs=5)
    assert counts["made up", fuzz_results.LEFT] and "stray" in failures[0]
