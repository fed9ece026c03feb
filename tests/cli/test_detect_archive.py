"""`asca detect --cluster`: what its workers write and what becomes of it, with and without Ray."""

import errno
import json
import re
import shutil
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from asca_deploy import detect_archive as archive
from asca_deploy.result_files import UNREADABLE_FILE
from asca_pillars.base import extras
from asca_pillars.base.errors import AscaError, BundleError, ClusterError, ConfigError, OutputError, ScanError
from asca_pillars.base.installation import install_command
from asca_pillars.cli.detect import detect
from asca_pillars.cluster.shards import Outcome, Shard
from asca_pillars.scans.scan_reader import read_scan, write_scan
from tests.cli.local_cluster import Here
from tests.deploy.conftest import make_scan, write_bundle

SCANS = 40
BAD = 7


@pytest.fixture(scope="module")
def bundle(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_bundle(tmp_path_factory.mktemp("bundles") / "tiny")


@pytest.fixture(scope="module")
def scans(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Forty tiny scans, one of them damaged."""
    folder = tmp_path_factory.mktemp("archive") / "scans"
    for number in range(SCANS):
        write_scan(folder / f"{number}.bin", make_scan(number, 300))
    (folder / f"{BAD}.bin").write_bytes(b"torn")
    return folder


@pytest.fixture(scope="module")
def alone(bundle: Path, scans: Path, tmp_path_factory: pytest.TempPathFactory) -> bytes:
    """What one process writes."""
    out = tmp_path_factory.mktemp("alone")
    with pytest.raises(ScanError, match="1 of 40"):
        detect([scans], out=out, bundle=bundle, threads=1, pictures=False)
    return (out / "detections.jsonl").read_bytes()


@pytest.fixture
def here(monkeypatch: pytest.MonkeyPatch) -> Here:
    runner = Here()
    monkeypatch.setattr(archive, "run_shards", runner)
    monkeypatch.setattr(archive, "require", lambda extra: None)
    return runner


def run(scans: Path, out: Path, bundle: Path, address: str = "made-up:1", **options: Any) -> None:
    with pytest.raises(ScanError, match=r"1 of 40 scans could not be read; they are named in .*unreadable\.jsonl"):
        detect([scans], out=out, bundle=bundle, cluster=address, **options)


def test_shards_become_what_one_process_writes(
    scans: Path, bundle: Path, alone: bytes, here: Here, tmp_path: Path
) -> None:
    run(scans, tmp_path / "out", bundle)
    assert [len(shard.items) for shard in here.begun] == [16, 16, 8]
    assert (tmp_path / "out" / "detections.jsonl").read_bytes() == alone
    (line,) = (tmp_path / "out" / UNREADABLE_FILE).read_text().splitlines()
    assert json.loads(line)["scan"] == str(scans / f"{BAD}.bin") and "4 bytes" in json.loads(line)["error"]
    assert len(alone.splitlines()) == SCANS - 1


def test_what_is_done_is_not_done_again(scans: Path, bundle: Path, alone: bytes, here: Here, tmp_path: Path) -> None:
    run(scans, tmp_path / "out", bundle)
    shards = sorted((tmp_path / "out" / "shards").glob("*.jsonl"))
    shards[1].unlink()
    (tmp_path / "out" / "detections.jsonl").unlink()
    here.begun.clear()
    run(scans, tmp_path / "out", bundle)
    assert [shard.first for shard in here.begun] == [16]
    run(scans, tmp_path / "out", bundle)
    assert len(here.begun) == 1
    assert (tmp_path / "out" / "detections.jsonl").read_bytes() == alone


@pytest.mark.parametrize("kept", ["3 lines", "a part of a line"])
def test_a_shard_that_was_cut_is_done_again(
    scans: Path, bundle: Path, alone: bytes, here: Here, tmp_path: Path, kept: str
) -> None:
    run(scans, tmp_path / "out", bundle)
    shard = min((tmp_path / "out" / "shards").glob("*.jsonl"))
    content = shard.read_bytes()
    shard.write_bytes(b"".join(content.splitlines(keepends=True)[:3]) if kept == "3 lines" else content[:-40])
    here.begun.clear()
    run(scans, tmp_path / "out", bundle)
    assert [shard.first for shard in here.begun] == [0]
    assert (tmp_path / "out" / "detections.jsonl").read_bytes() == alone


def test_what_tells_of_the_scans_of_a_cluster_does_not_stay_beside_others(
    scans: Path, bundle: Path, here: Here, tmp_path: Path
) -> None:
    out = tmp_path / "out"
    run(scans, out, bundle)
    assert (out / UNREADABLE_FILE).stat().st_size
    detect([scans / "1.bin"], out=out, bundle=bundle, threads=1, pictures=False)
    assert not (out / UNREADABLE_FILE).exists()
    assert (out / "shards" / "run.json").is_file()


def test_shards_are_not_written_through_a_link(scans: Path, bundle: Path, here: Here, tmp_path: Path) -> None:
    out = tmp_path / "out"
    run(scans, out, bundle)
    (out / "shards").rename(tmp_path / "elsewhere")
    (out / "shards").symlink_to(tmp_path / "elsewhere")
    with pytest.raises(OutputError, match="shards: is a link"):
        detect([scans], out=out, bundle=bundle, cluster="made-up:1")


def test_a_folder_of_shards_of_somebody_else_is_left_alone(
    scans: Path, bundle: Path, here: Here, tmp_path: Path
) -> None:
    detect([scans / "1.bin"], out=tmp_path, bundle=bundle, threads=1, pictures=False)
    (tmp_path / "shards").mkdir()
    (tmp_path / "shards" / "glass.txt").write_text("mine")
    with pytest.raises(OutputError, match=r"shards: holds glass\.txt and nothing that `asca detect` wrote"):
        detect([scans], out=tmp_path, bundle=bundle, cluster="made-up:1")
    assert len(list((tmp_path / "shards").iterdir())) == 1


def test_an_archive_may_grow(scans: Path, bundle: Path, here: Here, tmp_path: Path) -> None:
    grown = Path(shutil.copytree(scans, tmp_path / "scans"))
    run(grown, tmp_path / "out", bundle)
    write_scan(grown / "1000.bin", make_scan(1000))
    here.begun.clear()
    with pytest.raises(ScanError, match="1 of 41"):
        detect([grown], out=tmp_path / "out", bundle=bundle, cluster="made-up:1")
    assert [shard.first for shard in here.begun] == [32]
    assert len((tmp_path / "out" / "detections.jsonl").read_text().splitlines()) == SCANS


def test_scans_of_the_same_names_below_another_folder_are_others(
    scans: Path, bundle: Path, here: Here, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for day in ("monday", "tuesday"):
        shutil.copytree(scans, tmp_path / day / "scans")
    monkeypatch.chdir(tmp_path / "monday")
    run(Path("scans"), tmp_path / "out", bundle)
    run(Path("scans"), tmp_path / "out", bundle)
    assert len(here.begun) == 3
    monkeypatch.chdir(tmp_path / "tuesday")
    with pytest.raises(OutputError, match=r"working_folder = .*monday, now .*tuesday; choose another folder"):
        detect([Path("scans")], out=tmp_path / "out", bundle=bundle, cluster="made-up:1")


def test_scores_of_classes_reach_the_workers(scans: Path, bundle: Path, here: Here, tmp_path: Path) -> None:
    for scores in (["Car=0.9", "Cyclist=0.4"], ["Cyclist=0.4", "Car=0.9"]):  # the same run
        run(scans, tmp_path / "out", bundle, score=scores)
    assert len(here.begun) == 3
    with pytest.raises(ScanError, match="1 of 40"):
        detect(
            [scans], out=tmp_path / "alone", bundle=bundle, threads=1, pictures=False, score=["Cyclist=0.4", "Car=0.9"]
        )
    found, alone = ((tmp_path / name / "detections.jsonl").read_bytes() for name in ("out", "alone"))
    assert found == alone


def test_another_run_is_refused(scans: Path, bundle: Path, here: Here, tmp_path: Path) -> None:
    run(scans, tmp_path / "out", bundle)
    with pytest.raises(OutputError, match=r"score = None, now 0\.3; choose another folder"):
        detect([scans], out=tmp_path / "out", bundle=bundle, cluster="made-up:1", score=["0.3"])
    other = write_bundle(tmp_path / "other", uses_counts=False)
    with pytest.raises(OutputError, match="bundle_sha256 = "):
        detect([scans], out=tmp_path / "out", bundle=other, cluster="made-up:1")
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "shards").write_text("mine")
    with pytest.raises(OutputError, match="nothing that `asca detect` wrote"):
        detect([scans], out=tmp_path / "mine", bundle=bundle, cluster="made-up:1")


def test_relative_paths_are_those_of_the_command(
    scans: Path, bundle: Path, here: Here, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A worker has a working directory of its own."""
    shutil.copytree(scans, tmp_path / "home" / "scans")
    shutil.copytree(bundle, tmp_path / "home" / "bundle")
    (tmp_path / "elsewhere").mkdir()
    monkeypatch.chdir(tmp_path / "home")

    def end(shard: Shard) -> Iterator[Outcome[Any]]:
        with monkeypatch.context() as worker:
            worker.chdir(tmp_path / "elsewhere")
            yield here.done(shard)

    here.end = end
    named = [Path("scans") / f"{number}.bin" for number in (1, 2)]
    detect(named, out=Path("out"), bundle=Path("bundle"), cluster="made-up:1")
    lines = (tmp_path / "home" / "out" / "detections.jsonl").read_text().splitlines()
    assert [json.loads(line)["scan"] for line in lines] == ["scans/1.bin", "scans/2.bin"]
    assert not list((tmp_path / "elsewhere").iterdir())


def test_a_scan_that_ends_its_worker_is_a_line(
    scans: Path, bundle: Path, alone: bytes, here: Here, tmp_path: Path
) -> None:
    deadly = str(scans / "20.bin")

    def end(shard: Shard) -> Iterator[Outcome[Any]]:
        if len(shard.items) == 1 and shard.items[0][0] == deadly:
            yield Outcome(shard, died="worker")
        elif any(path == deadly for path, _ in shard.items):
            for half in reversed(shard.split):
                yield from end(half)
        else:
            yield here.done(shard)

    here.end = end
    with pytest.raises(ScanError, match="2 of 40"):
        detect([scans], out=tmp_path / "out", bundle=bundle, cluster="made-up:1")
    lines = [line for line in alone.decode().splitlines() if json.loads(line)["scan"] != deadly]
    assert (tmp_path / "out" / "detections.jsonl").read_text().splitlines() == lines
    assert "ended the process" in (tmp_path / "out" / UNREADABLE_FILE).read_text()
    assert len(list((tmp_path / "out" / "shards").glob("*.jsonl"))) == 3, "the halves have become the shard"


def test_an_error_that_nobody_foresaw_is_a_line(
    scans: Path, bundle: Path, here: Here, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(path: Path, **options: Any) -> Any:
        if path.name == "3.bin":
            raise ZeroDivisionError("a bug")
        return read_scan(path, **options)

    monkeypatch.setattr(f"{archive.__name__}.read_scan", fail)
    with pytest.raises(ScanError, match="2 of 40"):
        detect([scans], out=tmp_path / "out", bundle=bundle, cluster="made-up:1")
    assert '{"error": "ZeroDivisionError: a bug"' in (tmp_path / "out" / UNREADABLE_FILE).read_text()


def test_a_bad_moment_of_the_mount_is_waited_out(
    scans: Path, bundle: Path, alone: bytes, here: Here, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    tries = Counter[str]()

    def fail_at_first(path: Path, **options: Any) -> Any:
        tries[path.name] += 1
        if path.name in ("3.bin", "4.bin") and tries[path.name] < 3 + (path.name == "4.bin"):
            raise ScanError(f"{path}: cannot be read") from OSError(errno.EIO, "Input/output error")
        return read_scan(path, **options)

    monkeypatch.setattr(archive, "READ_AGAIN_AFTER_S", (0.0, 0.0))
    monkeypatch.setattr(f"{archive.__name__}.read_scan", fail_at_first)
    with pytest.raises(ScanError, match="2 of 40"):
        detect([scans], out=tmp_path / "out", bundle=bundle, cluster="made-up:1")
    assert (tries["3.bin"], tries["4.bin"], tries[f"{BAD}.bin"]) == (3, 3, 1)
    assert "4.bin: cannot be read" in (tmp_path / "out" / UNREADABLE_FILE).read_text()


def test_a_machine_that_does_not_see_the_scans_ends_the_run(
    scans: Path, bundle: Path, here: Here, tmp_path: Path
) -> None:
    """Instead of a line for each scan that says it were not there."""
    moved = Path(shutil.copytree(scans, tmp_path / "scans"))

    def end(shard: Shard) -> Iterator[Outcome[Any]]:
        moved.rename(tmp_path / "not mounted")
        yield here.done(shard)

    here.end = end
    with pytest.raises(ClusterError, match=r"does not see .*scans; mount it on every machine"):
        detect([moved], out=tmp_path / "out", bundle=bundle, cluster="made-up:1")
    assert not list((tmp_path / "out" / "shards").glob("*.jsonl"))


def test_a_machine_with_another_bundle_ends_the_run(scans: Path, bundle: Path, here: Here, tmp_path: Path) -> None:
    own = Path(shutil.copytree(bundle, tmp_path / "own"))
    manifest = own / "bundle.json"

    def end(shard: Shard) -> Iterator[Outcome[Any]]:
        manifest.write_text(manifest.read_text() + "\n")
        yield here.done(shard)

    here.end = end
    with pytest.raises(BundleError, match="is another bundle"):
        detect([scans], out=tmp_path / "out", bundle=own, cluster="made-up:1")


def test_options_that_do_not_go_together_are_named(scans: Path, here: Here, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="--pictures"):
        detect([scans], out=tmp_path, cluster="made-up:1", pictures=True)
    with pytest.raises(ConfigError, match="--provider auto"):
        detect([scans], out=tmp_path, cluster="made-up:1", provider="auto")
    assert not list(tmp_path.iterdir())


def test_without_ray_it_says_what_to_install(
    scans: Path, bundle: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(extras.EXTRAS, "cluster", ("no_such_ray",))
    with pytest.raises(AscaError, match=re.escape(install_command("cluster"))):
        detect([scans], out=tmp_path / "out", bundle=bundle, cluster="local")
    assert not (tmp_path / "out").exists()


def test_counts_are_those_of_the_lines(tmp_path: Path) -> None:
    lines = [
        archive.error_line("a", "torn"),
        '{"scan": "b", "boxes": []}\n',
        '{"scan": "{\\"error\\": ", "boxes": []}\n',
    ]
    assert archive.merge(lines, tmp_path) == (2, 1)
    assert (tmp_path / "detections.jsonl").read_text() == "".join(lines[1:])
