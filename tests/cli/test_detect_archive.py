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


def run(scans: Path, out: Path, bundle: Path, *, unreadable: int = 1, **options: Any) -> bytes:
    """Detect on the cluster, where that many of 40 scans cannot be read; the lines."""
    message = rf"{unreadable} of {SCANS} scans could not be read; they are named in .*unreadable\.jsonl"
    with pytest.raises(ScanError, match=message):
        start(scans, out, bundle, **options)
    return (out / "detections.jsonl").read_bytes()


def start(scans: Path, out: Path, bundle: Path, **options: Any) -> None:
    detect([scans], out=out, bundle=bundle, cluster="made-up:1", **options)


def test_shards_become_what_one_process_writes(
    scans: Path, bundle: Path, alone: bytes, here: Here, tmp_path: Path
) -> None:
    assert run(scans, tmp_path / "out", bundle) == alone
    assert [len(shard.items) for shard in here.begun] == [16, 16, 8]
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
    assert run(scans, tmp_path / "out", bundle) == alone
    assert [shard.first for shard in here.begun] == [16]


def test_what_tells_of_the_scans_of_a_cluster_does_not_stay_beside_others(
    scans: Path, bundle: Path, here: Here, tmp_path: Path
) -> None:
    out = tmp_path / "out"
    run(scans, out, bundle)
    assert (out / UNREADABLE_FILE).stat().st_size
    detect([scans / "1.bin"], out=out, bundle=bundle, threads=1, pictures=False)
    assert not (out / UNREADABLE_FILE).exists()
    assert (out / "shards" / "run.json").is_file()


def test_a_folder_of_shards_that_is_a_link_or_somebody_else_s_is_left_alone(
    scans: Path, bundle: Path, here: Here, tmp_path: Path
) -> None:
    out, elsewhere = tmp_path / "out", tmp_path / "elsewhere"
    run(scans, out, bundle)
    shards = (out / "shards").rename(elsewhere)
    (out / "shards").symlink_to(elsewhere)
    with pytest.raises(OutputError, match="shards: is a link"):
        start(scans, out, bundle)
    (out / "shards").unlink()
    (out / "shards").mkdir()
    (out / "shards" / "glass.txt").write_text("mine")
    with pytest.raises(OutputError, match=r"shards: holds glass\.txt and nothing that `asca detect` wrote"):
        start(scans, out, bundle)
    assert len(list((out / "shards").iterdir())) == 1 and shards.is_dir()


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
        start(Path("scans"), tmp_path / "out", bundle)


def test_scores_of_classes_reach_the_workers(scans: Path, bundle: Path, here: Here, tmp_path: Path) -> None:
    scores = ["Cyclist=0.4", "Car=0.9"]
    for given in (scores, scores[::-1]):  # the same run
        found = run(scans, tmp_path / "out", bundle, score=given)
    assert len(here.begun) == 3
    with pytest.raises(ScanError, match="1 of 40"):
        detect([scans], out=tmp_path / "alone", bundle=bundle, threads=1, pictures=False, score=scores)
    assert found == (tmp_path / "alone" / "detections.jsonl").read_bytes()


def test_another_run_is_refused(scans: Path, bundle: Path, here: Here, tmp_path: Path) -> None:
    run(scans, tmp_path / "out", bundle)
    with pytest.raises(OutputError, match=r"score = None, now 0\.3; choose another folder"):
        start(scans, tmp_path / "out", bundle, score=["0.3"])
    with pytest.raises(OutputError, match="bundle_sha256 = "):
        start(scans, tmp_path / "out", write_bundle(tmp_path / "other", uses_counts=False))


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
    lines = [line for line in alone.splitlines() if json.loads(line)["scan"] != deadly]
    assert run(scans, tmp_path / "out", bundle, unreadable=2).splitlines() == lines
    assert "ended the process" in (tmp_path / "out" / UNREADABLE_FILE).read_text()
    assert len(list((tmp_path / "out" / "shards").glob("*.jsonl"))) == 3, "the halves have become the shard"


def test_an_error_that_nobody_foresaw_is_a_line_and_a_bad_moment_of_the_mount_is_waited_out(
    scans: Path, bundle: Path, here: Here, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    tries = Counter[str]()

    def fail(path: Path, **options: Any) -> Any:
        tries[path.name] += 1
        if path.name == "2.bin":
            raise ZeroDivisionError("a bug")
        if path.name in ("3.bin", "4.bin") and tries[path.name] < 3 + (path.name == "4.bin"):
            raise ScanError(f"{path}: cannot be read") from OSError(errno.EIO, "Input/output error")
        return read_scan(path, **options)

    monkeypatch.setattr(archive, "READ_AGAIN_AFTER_S", (0.0, 0.0))
    monkeypatch.setattr(f"{archive.__name__}.read_scan", fail)
    run(scans, tmp_path / "out", bundle, unreadable=3)
    assert [tries[name] for name in ("2.bin", "3.bin", "4.bin", f"{BAD}.bin")] == [1, 3, 3, 1]
    unreadable = (tmp_path / "out" / UNREADABLE_FILE).read_text()
    assert '{"error": "ZeroDivisionError: a bug"' in unreadable and "4.bin: cannot be read" in unreadable


@pytest.mark.parametrize("what", ["scans", "bundle"])
def test_a_machine_that_is_not_set_up_alike_ends_the_run(
    scans: Path, bundle: Path, here: Here, tmp_path: Path, what: str
) -> None:
    """Instead of a line for each scan that says it were not there."""
    scans, bundle = (Path(shutil.copytree(path, tmp_path / path.name)) for path in (scans, bundle))

    def end(shard: Shard) -> Iterator[Outcome[Any]]:
        if what == "scans":
            scans.rename(tmp_path / "not mounted")
        else:
            (bundle / "bundle.json").write_text((bundle / "bundle.json").read_text() + "\n")
        yield here.done(shard)

    here.end = end
    message = "does not see .*scans; mount it on every machine" if what == "scans" else "is another bundle"
    with pytest.raises(ClusterError if what == "scans" else BundleError, match=message):
        start(scans, tmp_path / "out", bundle)
    assert not list((tmp_path / "out" / "shards").glob("*.jsonl"))


def test_options_that_do_not_go_together_are_named(scans: Path, bundle: Path, here: Here, tmp_path: Path) -> None:
    for options in ({"pictures": True}, {"provider": "auto"}):
        with pytest.raises(ConfigError, match=f"--{next(iter(options))}"):
            start(scans, tmp_path, bundle, **options)
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
