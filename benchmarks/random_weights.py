"""Bundles of an untrained network for timing: random weights take as long as trained ones.

    python -m benchmarks.random_weights bundles/                                  # the paper's size, K = 3
    asca bench scans/ --bundle bundles/int8 --compare bundles/float32
    python -m benchmarks.random_weights sparse/ --config asca_sim --neck sparse   # what does a sparse neck gain?
    python -m benchmarks.random_weights dense/ --config asca_sim --neck dense
    asca bench scans/ --bundle dense/int8 --compare sparse/int8

The weights are the same on every run. They show neither the accuracy of 8 bits nor the number of boxes.
"""

from dataclasses import replace
from pathlib import Path
from typing import Annotated, Literal, TypeAlias

import numpy as np
import torch
import typer
from numpy.typing import NDArray
from rich.console import Console
from torch import nn

from asca_deploy import sample_scan_path
from asca_export.bundle_writer import MIN_SCANS, ExportOptions
from asca_export.pillar.export import export_pillar_bundle
from asca_pillars.base.errors import ConfigError
from asca_pillars.cli.run_command import run_command
from asca_pillars.config.pillar import PillarModel
from asca_pillars.config.tree import load_config
from asca_pillars.models.build import Checkpoint
from asca_pillars.models.pillar.network import build_pillar_detector
from asca_pillars.models.pillar.preparation import batch_pillars
from asca_pillars.scans.scan_reader import read_scan

Neck: TypeAlias = Literal["dense", "sparse"]


def main(
    out: Annotated[Path, typer.Argument(help="Folder for the bundles float32 and int8.")],
    config: Annotated[str, typer.Option(help="YAML, or the name of one that ships.")] = "asca_pointpillars_kitti",
    neck: Annotated[Neck | None, typer.Option(help="Default: the configuration's.")] = None,
) -> None:
    """Export both, calibrated on the sample scan, each time without another eighth of its points."""
    console = Console(markup=False)
    points = read_scan(sample_scan_path()).points
    model = random_weights(config, points, neck)
    thinned = [np.delete(points, slice(part, None, MIN_SCANS), axis=0) for part in range(MIN_SCANS)]
    with console.status("Exporting") as status:
        options = ExportOptions(trained_on="nothing: random weights", progress=status.update)
        for name, calibration in (("float32", None), ("int8", thinned)):
            chosen = replace(options, calibration=calibration)
            bundle = export_pillar_bundle(model, out / name, [points] * MIN_SCANS, chosen)
            console.print(f"{out / name}: {bundle.backbone_gmac:.2f} GMAC, {bundle.precision}")


def random_weights(config: str, points: NDArray[np.float32], neck: Neck | None = None) -> Checkpoint:
    """Return a network with random weights, normalized on a scan (N, 4), so that its maps depend on the points.

    Args:
        config: YAML, or the name of one that ships.
        points: x, y, z in metres, LiDAR frame, and reflectance.
        neck: overrides the configuration's.
    """
    torch.manual_seed(0)
    resolved = load_config(config)
    model = resolved.model
    if not isinstance(model, PillarModel):
        raise ConfigError(f"{config}: model.kind {model.kind}; give a configuration of kind pillar")
    model = replace(model, network=replace(model.network, neck=neck or model.network.neck))
    detector = build_pillar_detector(model).train()
    norms = [module for module in detector.modules() if isinstance(module, (nn.BatchNorm1d, nn.BatchNorm2d))]
    for norm in norms:
        norm.momentum = 1.0  # the running statistics become those of this scan
    with torch.no_grad():
        pillars = model.spec.pillarize(points)
        detector(batch_pillars([pillars], [detector.preparation.place(pillars)]))
    return Checkpoint(replace(resolved, model=model), detector.eval(), 0)


if __name__ == "__main__":
    run_command(main)
