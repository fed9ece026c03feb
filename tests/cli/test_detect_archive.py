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
from asca_pillars.base import installation
from asca_pillars.base.errors import AscaError, BundleError, ClusterError, ConfigError, OutputError, ScanError
from asca_pillars.base.installation import install_command
from asca_pillars.cli.detect import detect
from asca_pillars.cluster import Outcome, Shard
from asca_pillars.scans.scan_reader import read_scan, write_scan
from tests.cli.local_cluster import Here
from tests.deploy.conftest import make_scan, write_bundle

SCANS = 40
BAD = 7


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


class Cluster(Here):
    """Detects scans into a folder by shards that run in this process."""

    def __init__(self, scans: Path, bundle: Path, out: Path) -> None:
        super().__init__()
        self.scans, self.bundle, self.out = scans, bundle, out

    def run(self, *, unreadable: int = 1, **options: Any) -> bytes:
        """Detect where that many of 40 scans cannot be read; the lines."""
        message = rf"{unreadable} of {SCANS} scans could not be read; they are named in .*unreadable\.jsonl"
        with pytest.raises(ScanError, match=message):
            self.start(**options)
        return (self.out / "detections.jsonl").read_bytes()

    def start(self, **options: Any) -> None:
        detect([self.scans], out=self.out, bundle=self.bundle, cluster="made-up:1", **options)

    @property
    def shards(self) -> list[Path]:
        return sorted((self.out / "shards").glob("*.jsonl"))

    @property
    def unreadable(self) -> str:
        return (self.out / UNREADABLE_FILE).read_text()


@pytest.fixture
def cluster(scans: Path, bundle: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Cluster:
    made = Cluster(scans, bundle, tmp_path / "out")
    monkeypatch.setattr(archive, "run_shards", made)
    monkeypatch.setattr(archive, "require", lambda extra: None)
    return made


def test_shards_become_what_one_process_writes_and_what_is_done_is_not_done_again(
    cluster: Cluster, alone: bytes
) -> None:
    assert cluster.run() == alone and len(alone.splitlines()) == SCANS - 1
    assert [len(shard.items) for shard in cluster.begun] == [16, 16, 8]
    (line,) = cluster.unreadable.splitlines()
    assert json.loads(line)["scan"] == str(cluster.scans / f"{BAD}.bin") and "4 bytes" in json.loads(line)["error"]
    cluster.shards[1].unlink()
    (cluster.out / "detections.jsonl").unlink()
    cluster.begun.clear()
    for _ in range(2):
        assert cluster.run() == alone
    assert [shard.first for shard in cluster.begun] == [16]
    detect([cluster.scans / "1.bin"], out=cluster.out, bundle=cluster.bundle, threads=1, pictures=False)
    assert not (cluster.out / UNREADABLE_FILE).exists(), "it told of others"
    assert (cluster.out / "shards" / "run.json").is_file()


def test_a_folder_of_shards_that_is_a_link_or_somebody_else_s_is_left_alone(cluster: Cluster, tmp_path: Path) -> None:
    cluster.run()
    shards = cluster.out / "shards"
    elsewhere = shards.rename(tmp_path / "elsewhere")
    shards.symlink_to(elsewhere)
    with pytest.raises(OutputError, match="shards: is a link"):
        cluster.start()
    shards.unlink()
    shards.mkdir()
    (shards / "glass.txt").write_text("mine")
    with pytest.raises(OutputError, match=r"shards: holds glass\.txt and nothing that `asca detect` wrote"):
        cluster.start()
    assert len(list(shards.iterdir())) == 1 and elsewhere.is_dir()


def test_another_run_is_refused(cluster: Cluster, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A run differs if scores or bundle do, and if scans of the same names lie below another folder."""
    for day in ("monday", "tuesday"):
        shutil.copytree(cluster.scans, tmp_path / day / "scans")
    monkeypatch.chdir(tmp_path / "monday")
    cluster.scans = Path("scans")
    scores = ["Cyclist=0.4", "Car=0.9"]
    for given in (scores, scores[::-1]):  # the same run
        found = cluster.run(score=given)
    assert len(cluster.begun) == 3
    with pytest.raises(ScanError, match="1 of 40"):
        detect([cluster.scans], out=tmp_path / "alone", bundle=cluster.bundle, threads=1, pictures=False, score=scores)
    assert found == (tmp_path / "alone" / "detections.jsonl").read_bytes(), "scores reach the workers"
    with pytest.raises(OutputError, match=r"score = .*, now 0\.3; choose another folder"):
        cluster.start(score=["0.3"])
    own, cluster.bundle = cluster.bundle, write_bundle(tmp_path / "other", uses_counts=False)
    with pytest.raises(OutputError, match="bundle_sha256 = "):
        cluster.start(score=scores)
    cluster.bundle = own
    monkeypatch.chdir(tmp_path / "tuesday")
    with pytest.raises(OutputError, match=r"working_folder = .*monday, now .*tuesday; choose another folder"):
        cluster.start(score=scores)


def test_relative_paths_are_those_of_the_command(
    cluster: Cluster, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A worker has a working directory of its own."""
    shutil.copytree(cluster.scans, tmp_path / "home" / "scans")
    shutil.copytree(cluster.bundle, tmp_path / "home" / "bundle")
    (tmp_path / "elsewhere").mkdir()
    monkeypatch.chdir(tmp_path / "home")

    def end(shard: Shard) -> Iterator[Outcome[Any]]:
        with monkeypatch.context() as worker:
            worker.chdir(tmp_path / "elsewhere")
            yield cluster.done(shard)

    cluster.end = end
    named = [Path("scans") / f"{number}.bin" for number in (1, 2)]
    detect(named, out=Path("out"), bundle=Path("bundle"), cluster="made-up:1")
    lines = (tmp_path / "home" / "out" / "detections.jsonl").read_text().splitlines()
    assert [json.loads(line)["scan"] for line in lines] == ["scans/1.bin", "scans/2.bin"]
    assert not list((tmp_path / "elsewhere").iterdir())


def test_a_scan_that_ends_its_worker_is_a_line(cluster: Cluster, alone: bytes) -> None:
    deadly = str(cluster.scans / "20.bin")

    def end(shard: Shard) -> Iterator[Outcome[Any]]:
        if len(shard.items) == 1 and shard.items[0][0] == deadly:
            yield Outcome(shard, died="worker")
        elif any(path == deadly for path, _ in shard.items):
            for half in reversed(shard.split):
                yield from end(half)
        else:
            yield cluster.done(shard)

    cluster.end = end
    lines = [line for line in alone.splitlines() if json.loads(line)["scan"] != deadly]
    assert cluster.run(unreadable=2).splitlines() == lines
    assert "ended the process" in cluster.unreadable
    assert len(cluster.shards) == 3, "the halves have become the shard"


def test_an_error_that_nobody_foresaw_is_a_line_and_a_bad_moment_of_the_mount_is_waited_out(
    cluster: Cluster, monkeypatch: pytest.MonkeyPatch
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
    cluster.run(unreadable=3)
    assert [tries[name] for name in ("2.bin", "3.bin", "4.bin", f"{BAD}.bin")] == [1, 3, 3, 1]
    assert (
        '{"error": "ZeroDivisionError: a bug"' in cluster.unreadable and "4.bin: cannot be read" in cluster.unreadable
    )


@pytest.mark.parametrize("what", ["scans", "bundle"])
def test_a_machine_that_is_not_set_up_alike_ends_the_run(cluster: Cluster, tmp_path: Path, what: str) -> None:
    """Instead of a line for each scan that says it were not there."""
    cluster.scans = Path(shutil.copytree(cluster.scans, tmp_path / "scans"))
    cluster.bundle = Path(shutil.copytree(cluster.bundle, tmp_path / "bundle"))

    def end(shard: Shard) -> Iterator[Outcome[Any]]:
        if what == "scans":
            cluster.scans.rename(tmp_path / "not mounted")
        else:
            with (cluster.bundle / "bundle.json").open("a") as manifest:
                manifest.write("\n")
        yield cluster.done(shard)

    cluster.end = end
    message = "does not see .*scans; mount it on every machine" if what == "scans" else "is another bundle"
    with pytest.raises(ClusterError if what == "scans" else BundleError, match=message):
        cluster.start()
    assert not cluster.shards


def test_what_cannot_be_is_refused_before_the_work(cluster: Cluster, monkeypatch: pytest.MonkeyPatch) -> None:
    for options in ({"pictures": True}, {"provider": "auto"}):
        with pytest.raises(ConfigError, match=f"--{next(iter(options))}"):
            cluster.start(**options)
    monkeypatch.undo()
    monkeypatch.setitem(installation.EXTRAS, "cluster", ("no_such_ray",))
    with pytest.raises(AscaError, match=re.escape(install_command("cluster"))):
        cluster.start()
    assert not cluster.out.exists()


def test_counts_are_those_of_the_lines(tmp_path: Path) -> None:
    lines = [
        archive.error_line("a", "torn"),
        '{"scan": "b", "boxes": []}\n',
        '{"scan": "{\\"error\\": ", "boxes": []}\n',
    ]
    assert archive.merge(lines, tmp_path) == (2, 1)
    assert (tmp_path / "detections.jsonl").read_text() == "".join(lines[1:])
