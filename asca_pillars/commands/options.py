"""Options that several commands share, declared once. Nothing heavy is imported here: `asca --help` is instant."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import typer

ScansArgument = Annotated[
    list[Path] | None,
    typer.Argument(
        help="Scans (.bin .npy .pcd .ply) and folders of them, searched to any depth. Default: the sample that comes "
        "with asca."
    ),
]
BundleOption = Annotated[
    Path | None,
    typer.Option(
        "--bundle",
        "-b",
        help="Model bundle: a folder, or asca_small_sim or asca_small_sim_int8, which come with asca. Default: int8.",
    ),
]
ProviderOption = Annotated[
    str, typer.Option("--provider", help="Where the network runs: cpu, auto, cuda, tensorrt, openvino.")
]
PrecisionOption = Annotated[
    str | None,
    typer.Option(
        "--precision",
        help="float32, or reduced: bfloat16, TF32 or float16 where the provider has it. "
        "Default: float32; with --provider auto either.",
    ),
]
ThreadsOption = Annotated[
    int | None, typer.Option("--threads", help="CPU threads. Default: the physical cores granted to the process.")
]
DataOption = Annotated[
    Path,
    typer.Option("--data", "-d", help="Folder of a dataset: KITTI's layout, or with a dataset.yaml (docs/DATA.md)."),
]
ConfigArgument = Annotated[
    Path, typer.Argument(help="YAML of the model and its recipe, or the name of one that ships.")
]
OverridesOption = Annotated[
    list[str] | None,
    typer.Option("--set", "-s", help="key.subkey=value, wins over the YAML. Repeatable: -s train.epochs=20"),
]
JsonOption = Annotated[Path | None, typer.Option("--json", help="Also write everything measured to this file.")]


@dataclass(frozen=True, kw_only=True)
class RuntimeOptions:
    """Which model runs, and how. The arguments of `asca_deploy.Detector` by the same names."""

    bundle: Path | None = None
    provider: str = "cpu"
    precision: str | None = None
    threads: int | None = None
