"""Options shared by several commands. Slow imports are avoided here, so that `asca --help` is fast."""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from asca_pillars.base.errors import ConfigError
from asca_pillars.scans.find_scans import NAMED_SUFFIXES, SCAN_SUFFIXES

if TYPE_CHECKING:
    from asca_pillars.scans.scan_settings import ScanSettings

_SCANS = (
    f"Scans ({' '.join(SCAN_SUFFIXES)}; {' '.join(NAMED_SUFFIXES)} by name) and folders of them, searched to any depth"
)
ScansArgument = Annotated[
    list[Path] | None, typer.Argument(help=f"{_SCANS}. Default: the sample that comes with asca.")
]
ScansOrRecordingArgument = Annotated[
    list[Path] | None,
    typer.Argument(
        help=f"{_SCANS}; or one recording (.mcap .db3 .bag .pcap, a rosbag2 folder). Default: the sample that comes "
        "with asca.",
    ),
]
BundleOption = Annotated[
    Path | None,
    typer.Option(
        "--bundle",
        "-b",
        help="Model bundle: a folder, or the name of one that comes with asca: default, fast (half as wide), accurate "
        "(with a second stage), all in 8 bits, or default_float32. Without it: default.",
        rich_help_panel="Input",
    ),
]
ScoreOption = Annotated[
    list[str] | None,
    typer.Option(
        "--score",
        help="VALUE or CLASS=VALUE: report detections, or those of a class, from this score on. Repeatable for "
        "classes. Default: the model's, per class.",
        rich_help_panel="Output",
    ),
]

ProviderOption = Annotated[
    str,
    typer.Option(
        "--provider", help="Where the network runs: cpu, auto, cuda, tensorrt, openvino.", rich_help_panel="Speed"
    ),
]
PrecisionOption = Annotated[
    str | None,
    typer.Option(
        "--precision",
        help="float32, or reduced: bfloat16, TF32 or float16 where the provider has it. "
        "Default: float32; with --provider auto either.",
        rich_help_panel="Speed",
    ),
]
ThreadsOption = Annotated[
    int | None,
    typer.Option(
        "--threads", help="CPU threads. Default: the physical cores granted to the process.", rich_help_panel="Speed"
    ),
]
DataOption = Annotated[
    Path,
    typer.Option(
        "--data",
        "-d",
        help="Folder of a dataset: KITTI's layout, or with a dataset.yaml (docs/DATA.md).",
        rich_help_panel="Input",
    ),
]
ConfigArgument = Annotated[
    Path, typer.Argument(help="YAML of the model and its recipe, or the name of one that ships.")
]
OverridesOption = Annotated[
    list[str] | None,
    typer.Option(
        "--set",
        "-s",
        help="key.subkey=value, wins over the YAML. Repeatable: -s train.epochs=20",
        rich_help_panel="Input",
    ),
]
InitOption = Annotated[
    Path | None,
    typer.Option(
        "--init",
        help="Weights that a new run starts from: a checkpoint, or a bundle that holds its own (folder, or name of one "
        "that ships). Where model.train_first_stage is false, its first stage alone is taken.",
        rich_help_panel="Input",
    ),
]
JsonOption = Annotated[
    Path | None, typer.Option("--json", help="Also write everything measured to this file.", rich_help_panel="Output")
]


SensorHeightOption = Annotated[
    str | None,
    typer.Option(
        "--sensor-height",
        help="Metres of the scans' origin above the ground (0 where z = 0 is the ground), or auto: estimated from the "
        "scans. Default: as in training.",
        rich_help_panel="Sensor",
    ),
]
AxesOption = Annotated[
    str,
    typer.Option(
        "--axes",
        help="x-forward, y-forward (x to the right), or where forward, left and up are found in the scan, such as "
        "-y,x,z or, with z down, x,-y,-z.",
        rich_help_panel="Sensor",
    ),
]
PoseOption = Annotated[
    Path | None,
    typer.Option(
        "--pose",
        help="Text file with a 4x4 matrix, 16 numbers row by row, from the scan to a level frame, x forward, y left, "
        "z up, in metres; instead of --axes.",
        rich_help_panel="Sensor",
    ),
]
ReflectanceScaleOption = Annotated[
    str,
    typer.Option(
        "--reflectance-scale",
        help="Stored value that is a reflectance of 1: 1, 100, 255, 65535. Default: by the files, once for a folder.",
        rich_help_panel="Sensor",
    ),
]
ColumnsOption = Annotated[
    int | None,
    typer.Option(
        "--columns",
        help="Values of a point in a .bin file. Default: 4, or 5 where the fifth counts rings.",
        rich_help_panel="Sensor",
    ),
]
TopicOption = Annotated[
    str | None,
    typer.Option(
        "--topic",
        help="Of a recording: the topic of its scans. Default: the only one.",
        rich_help_panel="Recording",
    ),
]
AroundOption = Annotated[
    bool,
    typer.Option(
        "--around",
        help="Look in every direction: in one pass with a model of whole revolutions, else in turned passes that are "
        "merged, each of which costs what a scan ahead costs.",
        rich_help_panel="Sensor",
    ),
]
ViewOption = Annotated[
    bool | None,
    typer.Option(
        "--around/--ahead",
        help="Look in every direction, or only ahead. Default: in every direction if the first scan lies all around "
        "the sensor, but not for KITTI's frames and the sample. A model of whole revolutions needs one pass, others "
        "several, each of which costs what a scan ahead costs.",
        show_default=False,
        rich_help_panel="Sensor",
    ),
]
VideoOption = Annotated[
    Path | None,
    typer.Option(
        "--video",
        help="Also write an .mp4 of the boxes, with identities and trails given --track. Needs the extra video.",
        rich_help_panel="Output",
    ),
]
VideoViewOption = Annotated[
    str, typer.Option("--video-view", help="above, or chase: in 3D from behind the sensor.", rich_help_panel="Output")
]
ClusterOption = Annotated[
    str | None,
    typer.Option(
        "--cluster",
        help="Work on a Ray cluster: its address (HOST:PORT), auto, or local for all cores of this machine. "
        "Needs the extra cluster, which `asca doctor` says how to install; docs/CLUSTER.md.",
        rich_help_panel="Speed",
    ),
]


def read_scores(texts: Sequence[str] | None) -> float | dict[str, float] | None:
    """Parse `--score`; return None if it was not given.

    Raises:
        ConfigError: one is not a score, or a score for every class is given with others.
    """
    scores: dict[str, float] = {}
    for text in texts or ():
        name, equals, value = text.rpartition("=")
        try:
            scores[name] = float(value)
        except ValueError:
            name, equals = "", "="
        if equals and not name:
            raise ConfigError(f"--score {text}: give a score, or a class and its score, such as Car=0.35")
    if "" not in scores:
        return scores or None
    if len(texts or ()) > 1:
        raise ConfigError(f"--score {scores['']:g} is for every class; give it alone, or CLASS=VALUE for each")
    return scores[""]


def scan_settings(
    *, sensor_height: str | None, axes: str, pose: Path | None, reflectance_scale: str, columns: int | None
) -> "ScanSettings":
    """Return the scan settings of the options.

    Raises:
        ConfigError: one is invalid.
    """
    from asca_pillars.scans.scan_settings import ScanSettings

    return ScanSettings(
        sensor_height=None if sensor_height is None else _number(sensor_height, "--sensor-height"),
        axes=axes,
        pose=None if pose is None else str(pose),
        reflectance_scale=_number(reflectance_scale, "--reflectance-scale"),
        columns=columns,
    )


def _number(text: str, option: str) -> Literal["auto"] | float:
    if text == "auto":
        return "auto"
    try:
        return float(text)
    except ValueError:
        raise ConfigError(f"{option} {text[:40]}: give a number or auto") from None
