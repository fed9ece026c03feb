#!/usr/bin/env python3
"""Install the lowest versions that pyproject.toml allows in a new virtual environment, and run what users run.

    python .ci/lowest_versions.py                                    before a release, with the oldest Python
    python .ci/lowest_versions.py --pin torch==2.13.0                where no CPU build of the oldest torch can be had
    python .ci/lowest_versions.py --newest --python python3.13 --extras eval,import,recordings,openvino

Needs nothing but Python and pip. It takes minutes, so .ci/run does not call it.
"""

import argparse
import os
import re
import subprocess
import sys
import tempfile
import time
import tomllib
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parent.parent
DENSE_INT8 = str(ROOT / "tests" / "bundles" / "dense_int8")
EXTRAS = ("train", "sim", "eval", "import", "recordings", "openvino")
"""Those that can be installed together in their lowest versions: rerun-sdk of `view` needs NumPy 2."""
_REQUIREMENT = re.compile(r"(?P<name>[\w.-]+)(?:\[(?P<extras>[\w,-]+)\])?(?P<bounds>[^;]*)")

DETECT = ("asca", "detect", "--out", "default")
# Each is one command, after which what it names lies there.
WITHOUT_TORCH = (
    ("asca", "doctor"),
    ("asca", "simulate", "data", "--frames", "10", "--view", "camera", "--val-share", "0.2", "--seed", "1"),
    ("asca", "inspect", "data", "-c", "asca_small_sparse_sim"),
    ("asca", "detect", "data/training/velodyne", "--out", "detections"),
    ("asca", "bench", "data/training/velodyne", "-b", "fast"),
)
BY_EXTRA = {
    "train": (
        (
            *("asca", "train", "asca_small_sparse_sim", "--data", "data", "--out", "run"),
            *("-s", "train.epochs=1", "-s", "train.batch_size=4"),
        ),
        ("asca", "eval", "run/checkpoints/last.ckpt", "--data", "data", "--out", "evaluation"),
        ("asca", "export", "run/checkpoints/last.ckpt", "-o", "bundle", "--scans", "data/training/velodyne"),
        ("asca", "export", "bundle", "--golden", "-o", "golden", "--scans", "data/training/velodyne/000000.bin"),
        (
            *("asca", "export", "run/checkpoints/last.ckpt", "-o", "bundle_int8"),
            *("--int8", "--calibrate", "data/training/velodyne"),
        ),
        ("asca", "detect", "data/training/velodyne/000000.bin", "-b", "bundle_int8", "--out", "int8"),
    ),
    "eval": (("asca", "eval", "--data", "data", "--out", "curves"),),
    "import": (("asca", "detect", "sweep.feather", "--out", "feather"), ("asca", "detect", "scan.laz", "--out", "laz")),
    "recordings": (
        ("asca", "detect", "drive.mcap", "--out", "mcap", "--foxglove", "boxes.mcap"),
        ("asca", "detect", "drive", "--out", "rosbag2"),
        ("asca", "detect", "drive.bag", "--out", "rosbag"),
    ),
    "openvino": (("asca", "detect", "-b", DENSE_INT8, "--provider", "openvino", "--out", "openvino"),),
}
"""What needs an extra; `made_files` makes what they read."""


def requirements(project: Mapping[str, Any], extras: Iterable[str]) -> Iterator[str]:
    """The requirements of a `[project]` table with these extras, its references to itself resolved."""
    optional = project["optional-dependencies"]
    pending = [*project["dependencies"], *(one for extra in extras for one in optional[extra])]
    for requirement in pending:
        match = _REQUIREMENT.match(requirement)
        assert match is not None, requirement
        if match["name"] == project["name"]:
            pending += [one for extra in match["extras"].split(",") for one in optional[extra]]
        else:
            yield requirement


def lowest_versions(project: Mapping[str, Any], extras: Iterable[str]) -> dict[str, str]:
    """The lowest version that is allowed of each distribution, by name.

    Raises:
        ValueError: one has no lower bound, or two.
    """
    found: dict[str, str] = {}
    for requirement in requirements(project, extras):
        match = _REQUIREMENT.match(requirement)
        assert match is not None, requirement
        bound = re.search(r"[>=]=\s*([\w.]+)", match["bounds"])
        if bound is None:
            raise ValueError(f"pyproject.toml: {requirement!r} has no lower bound; give the oldest version that works")
        if found.setdefault(match["name"], bound[1]) != bound[1]:
            raise ValueError(f"pyproject.toml: {requirement!r} is elsewhere bound to {found[match['name']]}")
    return found


def constraints(project: Mapping[str, Any], extras: Iterable[str], pins: Iterable[str]) -> str:
    """A constraints file for pip: the lowest versions, but for those that are pinned otherwise."""
    versions = lowest_versions(project, extras)
    for pin in pins:
        name, _, version = pin.partition("==")
        versions[name] = version
    return "".join(f"{name}=={version}\n" for name, version in versions.items())


MADE_FILES = """
import sys
from pathlib import Path
import numpy as np
from asca_deploy import sample_scan_path
from asca_pillars import read_scan

points = read_scan(sample_scan_path()).points[::4]
if "import" in sys.argv:
    import pyarrow
    from pyarrow import feather
    columns = dict(zip(("x", "y", "z", "intensity"), points.T.astype(np.float32)))
    columns["intensity"] = (columns["intensity"] * 255).astype(np.uint8)
    feather.write_feather(pyarrow.table(columns), "sweep.feather")
    import laspy
    cloud = laspy.create(point_format=0, file_version="1.2")
    cloud.header.scales = [0.001] * 3
    cloud.x, cloud.y, cloud.z = points[:, :3].T
    cloud.intensity = columns["intensity"]
    cloud.write("scan.laz")
if "recordings" in sys.argv:
    sys.path.insert(0, sys.argv[1])
    from benchmarks.made_recordings import write_recording
    for name in ("drive.mcap", "drive", "drive.bag"):
        write_recording(Path(name), iter([(10**9, points), (2 * 10**9, points)]))
"""


def main() -> None:
    """Install and run; the exit code is that of the first command that fails."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--python", default=sys.executable, help="the interpreter; default: this one")
    parser.add_argument("--newest", action="store_true", help="the newest versions instead of the lowest")
    parser.add_argument("--extras", default=",".join(EXTRAS), help="which extras, divided by commas")
    parser.add_argument("--pin", action="append", default=[], metavar="NAME==VERSION", help="instead of the lowest")
    options = parser.parse_args()
    extras = [extra for extra in options.extras.split(",") if extra]
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    with tempfile.TemporaryDirectory() as folder:
        work = Path(folder)
        newest = "".join(f"{pin}\n" for pin in options.pin)
        pinned = newest if options.newest else constraints(project, extras, options.pin)
        (work / "constraints.txt").write_text(pinned, encoding="utf-8")
        print(pinned or "the newest versions", flush=True)
        run((options.python, "-m", "venv", "venv"), work)
        install = ("python", "-m", "pip", "install", "--quiet", "-c", "constraints.txt")
        run((*install, str(ROOT)), work)
        run(DETECT, work)
        run((*install, f"{ROOT}[{','.join(extras)}]"), work)
        run(("python", "-m", "pip", "check"), work)
        run(("python", "-m", "pip", "list"), work)
        for command in WITHOUT_TORCH:
            run(command, work)
        run(("python", "-c", MADE_FILES, str(ROOT), *extras), work, shown="made files")
        for extra in extras:
            for command in BY_EXTRA.get(extra, ()):
                run(command, work)
    left_out = ", ".join(extra for extra in BY_EXTRA if extra not in extras)
    print(f"all of it ran{f'; not run: {left_out}' if left_out else ''}")


def run(command: tuple[str, ...], work: Path, shown: str = "") -> None:
    """Run a command in the new environment; end this process if it fails."""
    start = time.monotonic()
    print(f"\n== {shown or ' '.join(command)}", flush=True)
    environment = os.environ | {"PATH": f"{work / 'venv' / 'bin'}{os.pathsep}{os.environ['PATH']}"}
    environment.pop("PYTHONPATH", None)
    code = subprocess.run(command, cwd=work, env=environment, check=False).returncode
    print(f"   {time.monotonic() - start:.0f} s", flush=True)
    if code:
        sys.exit(code)


if __name__ == "__main__":
    main()
