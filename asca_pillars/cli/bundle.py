"""`asca bundle`: list, description and verification of bundles."""

from pathlib import Path
from typing import Annotated

import typer

app = typer.Typer(help="List, describe and verify model bundles.", no_args_is_help=True)

_BundleArgument = Annotated[
    Path | None,
    typer.Argument(help="Folder of a bundle, or the name of one that comes with asca. Without it: default."),
]
_AsJson = Annotated[bool, typer.Option("--json", help="Print JSON instead, for programs.")]


@app.command("list")
def list_bundles(*, json: _AsJson = False) -> None:
    """List the bundles that come with asca: kind, arithmetic, size and license.

    Example: asca bundle list
    """
    import json as json_module

    from asca_deploy import default_bundle_path, shipped_bundles
    from asca_deploy.shipped import about_bundle

    rows = {name: about_bundle(folder) for name, folder in shipped_bundles().items()}
    if json:
        print(json_module.dumps(rows, indent=1))
        return
    for name, about in rows.items():
        default = ", the default" if name == default_bundle_path().name else ""
        size = f"{about['size_bytes'] / 2**20:.1f} MiB"
        print(f"{name}: {about['kind']}, {about['precision']}, {size}, {about['license']}{default}")


@app.command()
def info(bundle: _BundleArgument = None, *, json: _AsJson = False) -> None:
    """Say what a bundle is: name, digest of its weights, version of the export, training data, license.

    Example: asca bundle info my_bundle/ --json
    """
    import json as json_module

    from asca_deploy.shipped import about_bundle, find_bundle

    about = about_bundle(find_bundle(bundle))
    if json:
        print(json_module.dumps(about, indent=1))
        return
    for key, value in about.items():
        print(f"{key}: {', '.join(map(str, value)) if isinstance(value, list) else value}")


@app.command()
def verify(bundle: _BundleArgument = None) -> None:
    """Compare every file of a bundle with the digests in its bundle.json, and run the model on the sample scan.

    The exit code is 4 if it is damaged, with the file and the remedy, and 5 if it does not run here.

    Example: asca bundle verify my_bundle/
    """
    import logging

    from asca_deploy import Detector
    from asca_deploy.shipped import find_bundle, sample_scan_path
    from asca_pillars.scans.scan_reader import read_scan

    logging.getLogger("asca_pillars").setLevel(logging.ERROR)  # the sample need not be like the scans of its training
    folder = find_bundle(bundle)
    detector = Detector(folder)  # compares hashes, metadata and shapes
    detections = detector(read_scan(sample_scan_path()).points)
    made_by = detector.made_by
    print(f"{folder}: whole; {len(detections)} boxes in the sample scan, {detections.report.total_ms:.0f} ms")
    print(f"{made_by['model']}, weights {made_by['weights_sha256'][:12]}, asca-pillars {made_by['version']}")
