"""What `asca export` writes from a bundle for runtimes in other languages. Needs no PyTorch."""

from collections.abc import Mapping
from pathlib import Path

from rich.console import Console

from asca_deploy import find_bundle, sample_scan_path
from asca_deploy.browser_page import START, find_ort_web, write_page
from asca_deploy.golden import GOLDEN, write_golden
from asca_pillars.base.errors import ConfigError
from asca_pillars.scans.find_scans import find_scans


def export_for_runtime(
    bundle: Path,
    out: Path,
    scans: Path | None,
    of_a_checkpoint: Mapping[str, object],
    *,
    golden: bool,
    browser: bool,
    ort_web: Path | None,
) -> None:
    """`asca export --golden` and `asca export --browser`.

    Args:
        bundle: folder, or name of one that ships.
        out: folder to be written.
        scans: the scan, or a folder of which the first is taken; None for the one that comes with the package.
        of_a_checkpoint: options, by name, that a bundle has no use for.
        golden, browser: which of the two; one of them.
        ort_web: npm's package onnxruntime-web, for `browser`.

    Raises:
        ConfigError: options that do not go together.
    """
    if golden == browser or (ort_web is not None and not browser):
        raise ConfigError("give one of --golden and --browser; --ort-web goes with --browser")
    if given := [name for name, value in of_a_checkpoint.items() if value]:
        raise ConfigError(f"{given[0]} is for a checkpoint, and --golden and --browser read a bundle; leave it out")
    folder = find_bundle(bundle)
    scan = sample_scan_path() if scans is None else find_scans(scans)[0]
    console = Console(markup=False)
    if browser:
        size_bytes = write_page(out, folder, scan, find_ort_web(ort_web))
        console.print(f"{out}: {size_bytes / 1e6:.0f} MB. {START.format(out=out)}", soft_wrap=True)
        return
    stages = write_golden(out, folder, scan)
    arrays = [array for named in stages.values() for array in named.values()]
    size_bytes = sum(array.nbytes for array in arrays)
    boxes = len(stages["suppress"]["boxes"])
    console.print(
        f"{out}: {len(arrays)} arrays, {size_bytes / 1e6:.0f} MB, {boxes} boxes of {scan.name}; {GOLDEN} names them",
        soft_wrap=True,
    )
