"""Reissue of a bundle for this version, with unchanged networks.

    python -m asca_export.reissue asca_small_sim --scans data/sim/training/velodyne -o bundles/asca_small_sim

Bundles of an older schema can be read without it. Use it before publishing one: the graphs get the current stamp, and
`expected_input` is measured on scans like those of the training.
"""

import shutil
from dataclasses import replace
from pathlib import Path
from typing import Annotated

import typer

from asca_deploy.bundle import BUNDLE_FOLDER
from asca_deploy.manifest import load_pillar_bundle, write_bundle_manifest
from asca_deploy.shipped import find_bundle
from asca_export import graphs
from asca_pillars.base.files import WEIGHTS_FILE, atomic_directory
from asca_pillars.scans.find_scans import find_scans
from asca_pillars.scans.measure_input import measure_expected_input
from asca_pillars.scans.scan_reader import read_scan


def main(
    bundle: Annotated[Path, typer.Argument(help="A bundle's folder, or the name of one that ships.")],
    scans: Annotated[Path, typer.Option(help="Scans like those that the model was trained on.")],
    out: Annotated[Path, typer.Option("--out", "-o", help="Folder for the new bundle; must not exist.")],
    camera_view: Annotated[bool, typer.Option(help="Whether they are cropped to the camera's image.")] = True,
    training: Annotated[
        bool,
        typer.Option(help="They are of the training set; otherwise they stand in for it, and the manifest says so."),
    ] = False,
) -> None:
    """Write the bundle again with the expected input measured on the scans."""
    if out.exists():
        raise typer.BadParameter(f"{out} exists; name another folder")
    source = find_bundle(bundle)
    loaded = load_pillar_bundle(source)
    expected = measure_expected_input((read_scan(path).points for path in find_scans(scans)), camera_view)
    with atomic_directory(out, *BUNDLE_FOLDER) as folder:
        for name, graph in loaded.graphs.items():
            shutil.copyfile(source / graph.file, graphs.graph_path(folder, name))
        if loaded.provenance.weights_file:
            shutil.copyfile(source / WEIGHTS_FILE, folder / WEIGHTS_FILE)
        known = replace(loaded, expected_input=expected, expected_input_from="training" if training else "export")
        signed = graphs.sign(folder, known)
        write_bundle_manifest(folder, signed)


if __name__ == "__main__":
    typer.run(main)
