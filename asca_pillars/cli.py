"""The command `asca`: thin, and each command imports what it needs when it runs, so that --help is instant."""

import io
import sys
from pathlib import Path
from typing import Annotated, Literal, NoReturn

import typer

from asca_pillars import __version__
from asca_pillars.errors import AscaError, printable

app = typer.Typer(
    help="LiDAR 3D detection: boxes from a point cloud on an ordinary CPU, and the pipeline that trains the model.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
)

Bundle = Annotated[
    Path | None,
    typer.Option(
        "--bundle",
        "-b",
        help="Model bundle: a folder, or asca_small_sim or asca_small_sim_int8, which come with asca. Default: int8.",
    ),
]
ProviderName = Annotated[str, typer.Option(help="Where the network runs: cpu, auto, cuda, tensorrt, openvino.")]
Precision = Annotated[
    str | None,
    typer.Option(
        help="float32, or reduced: bfloat16, TF32 or float16 where the provider has it. "
        "Default: float32; with --provider auto either."
    ),
]
Threads = Annotated[int | None, typer.Option(help="CPU threads. Default: the physical cores granted to the process.")]


def main() -> None:
    """Run the command; what the user can mend is one line on stderr and exit code 2."""
    if isinstance(sys.stdout, io.TextIOWrapper):
        sys.stdout.reconfigure(errors="replace")  # an ASCII terminal gets `?` for `°`, not a traceback
    try:
        app()
    except AscaError as error:
        _fail(str(error))
    except OSError as error:
        _fail(f"{error.filename}: {error.strerror or error}" if error.filename else str(error.strerror or error))
    except MemoryError as error:
        _fail(f"not enough memory ({str(error) or 'no more is to be had'}); give it smaller input, or more memory")
    except RecursionError:
        _fail("the input is nested too deeply to be read; simplify the file or the option")


def _fail(message: str) -> NoReturn:
    print(f"asca: {printable(message)}", file=sys.stderr)
    sys.exit(2)


@app.callback(invoke_without_command=True)
def _version(
    version: Annotated[bool, typer.Option("--version", help="Print the version and stop.")] = False,
) -> None:
    if version:
        print(__version__)
        raise typer.Exit


@app.command()
def detect(
    scans: Annotated[
        Path | None,
        typer.Argument(
            help="A scan (.bin .npy .pcd .ply) or a folder of them. Default: the sample that comes with asca."
        ),
    ] = None,
    out: Annotated[Path, typer.Option("--out", "-o", help="Folder for pictures and boxes.")] = Path("detections"),
    bundle: Bundle = None,
    score: Annotated[
        float | None,
        typer.Option(help="Report detections from this score on. Default: the bundle's, per class."),
    ] = None,
    provider: ProviderName = "cpu",
    precision: Precision = None,
    threads: Threads = None,
) -> None:
    """Find cars, pedestrians and cyclists; write a bird's-eye picture and the boxes of each scan.

    NAME.json holds the boxes in the LiDAR's frame. In a KITTI folder NAME.txt is KITTI text, and the boxes are drawn
    on the camera image.
    """
    from asca_pillars.commands.detect import run

    run(scans, out, bundle, score, provider, precision, threads)


@app.command()
def bench(
    scans: Annotated[Path | None, typer.Argument(help="A scan or a folder of them. Default: the sample.")] = None,
    bundle: Bundle = None,
    provider: ProviderName = "cpu",
    precision: Precision = None,
    threads: Threads = None,
    rounds: Annotated[int, typer.Option(min=1, help="Timed passes over the scans, for each table.")] = 30,
    compare: Annotated[
        list[Path] | None,
        typer.Option(
            help="Another bundle, run in turn with the first on the same scans: how many times as fast it is, with "
            "quartiles over the rounds. Such ratios hold on a busy machine, times do not. Repeatable."
        ),
    ] = None,
    matrix: Annotated[
        bool,
        typer.Option(
            "--matrix",
            help="Every provider, precision and number of threads in turn (of the --compare bundles too): speed, and "
            "how far the boxes are from float32 on the stock CPU provider. What cannot run says why.",
        ),
    ] = False,
    scaling: Annotated[
        bool, typer.Option("--scaling", help="Each stage at 1,000 to 1,000,000 points, made from the first scan.")
    ] = False,
    stream: Annotated[
        bool,
        typer.Option("--stream", help="Scans per second and latency of detector.stream(scans) beside single calls."),
    ] = False,
    cold: Annotated[
        bool,
        typer.Option("--cold", help="New processes: seconds to the first boxes, and the peak memory of asca detect."),
    ] = False,
    json: Annotated[Path | None, typer.Option("--json", help="Also write everything measured to this file.")] = None,
) -> None:
    """Time every stage from points to boxes: p50, p95, FPS, cold start, memory, and the machine it ran on.

    Two lines say where to look for more speed: what is spent outside the two graphs, and the roofline, the share of the
    machine's measured matrix multiplications per second that the backbone gets out of it.
    """
    from asca_pillars.commands.bench import Parts, run

    run(scans, bundle, provider, precision, threads, rounds, Parts(compare or (), matrix, scaling, stream, cold), json)


@app.command()
def simulate(
    out: Annotated[Path, typer.Argument(help="Folder for the KITTI-layout dataset.")],
    frames: Annotated[
        int | None,
        typer.Option(
            "--frames",
            "-n",
            min=1,
            help="Frames to write. Default: 100; with --report none where there are scans already.",
        ),
    ] = None,
    seed: Annotated[int, typer.Option(min=0, help="Same seed, same bytes, whatever the number of workers.")] = 0,
    workers: Annotated[int, typer.Option("--workers", "-w", min=1, help="Processes.")] = 2,
    config: Annotated[
        str | None,
        typer.Option(
            "--config", "-c", help="YAML of scenes and sensor, or the name of one that ships. Default: KITTI's."
        ),
    ] = None,
    view: Annotated[
        str | None,
        typer.Option(
            help="full: 360 degrees, of which the camera's part is labelled, as in KITTI; around: 360 degrees, all "
            "of it labelled; camera: only what the camera sees, 6x smaller. Default: the config's; else full."
        ),
    ] = None,
    val_share: Annotated[
        float, typer.Option(min=0, max=1, help="Share of the frames listed in ImageSets/val.txt.")
    ] = 0.1,
    report: Annotated[
        bool,
        typer.Option(
            "--report",
            help="Compare the frames with KITTI's statistics: tables and plots in OUT/report/. "
            "Needs matplotlib: pip install 'asca-pillars[eval]'.",
        ),
    ] = False,
    like: Annotated[
        Path | None,
        typer.Option(
            "--like",
            help="Labelled real frames in KITTI's layout: compare each object in them with simulated ones at like "
            "distance, angle of view and occlusion; table, JSON and picture in OUT/report/. Needs matplotlib, too.",
        ),
    ] = None,
    bundle: Annotated[
        Path | None,
        typer.Option(
            "--bundle",
            "-b",
            help="With --like: also compare the scores that this bundle (or checkpoint) gives to real objects and "
            "their look-alikes, and how often it fires at what has no label.",
        ),
    ] = None,
) -> None:
    """Write simulated street scans with labels in KITTI's layout, and say how like real ones they are.

    With --report or --like, a folder that holds scans already, simulated or real, is compared as it is unless --frames
    is given.

    Examples: asca simulate data/sim -n 10000 --view camera; asca simulate data/all -n 10000 --view around;
    asca simulate data/sim --report --like data/kitti --bundle my_bundle.
    """
    from asca_pillars.commands.simulate import run

    run(out, frames, seed, workers, config, view, val_share, report, like, bundle)


@app.command()
def inspect(
    data: Annotated[Path, typer.Argument(help="KITTI-layout folder with training/ and ImageSets/.")],
    config: Annotated[Path, typer.Option("--config", "-c", help="YAML to train with, or the name of one that ships.")],
    split: Annotated[
        str | None, typer.Option(help="A list in ImageSets/, or training for every scan. Default: data.train_set.")
    ] = None,
    frames: Annotated[int, typer.Option("--frames", "-n", min=1, help="Look at so many frames, evenly spaced.")] = 500,
    json: Annotated[Path | None, typer.Option("--json", help="Also write what was found to this file.")] = None,
) -> None:
    """Look at a dataset before training: objects, points, sizes and positives per class, ranges, scans.

    Warnings name their remedy. A class that would have no positive anchor at all is an error: exit code 2.
    """
    from asca_pillars.commands.inspect import run

    run(data, config, split, frames, json)


@app.command()
def prepare(
    config: Annotated[Path, typer.Argument(help="YAML of the model and its recipe, or the name of one that ships.")],
    data: Annotated[Path, typer.Option("--data", "-d", help="KITTI-layout folder with training/ and ImageSets/.")],
    override: Annotated[
        list[str] | None,
        typer.Option("--set", "-s", help="key.subkey=value, wins over the YAML. Repeatable: -s data.prepared=DIR"),
    ] = None,
    workers: Annotated[int, typer.Option("--workers", "-w", min=1, help="Processes.")] = 2,
) -> None:
    """Compute once what GT-Aug and RS-Aug need of a dataset: the object database and the maps of free ground.

    Training does the same on first use; what is there and unchanged is used again. Without an insertion method in
    the config, what RS-Aug needs is prepared.
    """
    from asca_pillars.commands.prepare import run

    run(config, data, override or [], workers)


@app.command()
def train(
    config: Annotated[Path, typer.Argument(help="YAML of the model and its recipe, or the name of one that ships.")],
    data: Annotated[Path, typer.Option("--data", "-d", help="KITTI-layout folder with training/ and ImageSets/.")],
    out: Annotated[Path, typer.Option("--out", "-o", help="Folder of the run; an interrupted run there is resumed.")],
    override: Annotated[
        list[str] | None,
        typer.Option("--set", "-s", help="key.subkey=value, wins over the YAML. Repeatable: -s train.epochs=20"),
    ] = None,
    devices: Annotated[str, typer.Option(help="Devices on this machine: a number or auto.")] = "auto",
    num_nodes: Annotated[
        int, typer.Option(min=1, help="Machines that train together (torchrun or SLURM starts each).")
    ] = 1,
    init: Annotated[
        Path | None, typer.Option(help="Checkpoint whose weights a new run starts from, to go on with other data.")
    ] = None,
) -> None:
    """Train a detector; checkpoints, TensorBoard logs and the resolved config go to the run's folder."""
    from asca_pillars.commands.train import run

    run(config, data, out, override or [], devices, num_nodes, init)


@app.command("eval")
def evaluate(
    model: Annotated[
        Path | None,
        typer.Argument(help="Bundle (folder) or checkpoint (.ckpt). Default: the bundle that comes with asca."),
    ] = None,
    data: Annotated[
        Path | None, typer.Option("--data", "-d", help="KITTI-layout folder whose labels count; a model is run on it.")
    ] = None,
    split: Annotated[str, typer.Option(help="A list of ImageSets/, or training for every frame; with --data.")] = "val",
    predictions: Annotated[
        Path | None,
        typer.Option(
            help="Folder of KITTI text with scores, instead of a model; one file per frame, empty if nothing was found."
        ),
    ] = None,
    labels: Annotated[
        Path | None, typer.Option(help="Folder of KITTI labels for --predictions. Default: those of --data.")
    ] = None,
    out: Annotated[
        Path, typer.Option("--out", "-o", help="Folder for report, curves, gallery and the model's predictions.")
    ] = Path("evaluation"),
    json: Annotated[Path | None, typer.Option("--json", help="Also write the report's JSON to this file.")] = None,
    gallery: Annotated[
        int | None, typer.Option(min=0, help="Worst frames to draw. Default: 8 if there are scans (--data).")
    ] = None,
    score: Annotated[
        float | None,
        typer.Option(
            help="Score from which on detections count for recall, precision and gallery. "
            "Default: the model's, per class; 0.3 for --predictions."
        ),
    ] = None,
    min_score: Annotated[
        float,
        typer.Option(min=0, max=1, help="Lowest score that a model is run with: AP needs the weak detections too."),
    ] = 0.05,
    protocol: Annotated[
        Literal["kitti", "waymo"],
        typer.Option(
            help="kitti: AP and AOS of Car, Pedestrian and Cyclist. waymo: AP and APH of any class, by level and range."
        ),
    ] = "kitti",
    provider: ProviderName = "cpu",
    precision: Precision = None,
    threads: Threads = None,
) -> None:
    """Score a model, or finished predictions, by KITTI's protocol: AP and AOS, by distance, recall and precision.

    With --protocol waymo by Waymo's metric: AP and APH at LEVEL_1 and LEVEL_2, everywhere and by range.
    Frames without a prediction file are left out, as by KITTI's own tool, and named in every form of the report.
    """
    from asca_pillars.commands.eval import run

    where = provider, precision, threads
    run(model, data, split, predictions, labels, out, json, gallery, score, min_score, *where, protocol)


@app.command()
def export(
    checkpoint: Annotated[Path, typer.Argument(help="RUN/checkpoints/best.ckpt or last.ckpt.")],
    out: Annotated[Path, typer.Option("--out", "-o", help="Folder of the bundle.")],
    scans: Annotated[
        Path | None,
        typer.Option(help="Scans like those trained on, to prove parity on. Default: 8 simulated ones."),
    ] = None,
    trained_on: Annotated[str, typer.Option(help="What the weights have seen, for the manifest.")] = "not stated",
    score: Annotated[
        list[str] | None,
        typer.Option(help="CLASS=VALUE: report this class from this score on. Repeatable. Default: the config's."),
    ] = None,
    int8: Annotated[
        bool, typer.Option("--int8", help="8-bit backbone: several times faster on a CPU, a quarter of the size.")
    ] = False,
    calibrate: Annotated[
        Path | None,
        typer.Option(
            help="Folder of scans like those trained on, to calibrate with; 96, evenly spaced. Default: simulated ones."
        ),
    ] = None,
) -> None:
    """Export to ONNX and prove on scans that the bundle is the same detector; fails if it is not.

    With --int8 the proven graphs become 8-bit ones; bundle.json says how far they are from the float ones, layer by
    layer, and which layers stay in floating point because of it.
    """
    from asca_pillars.commands.export import run

    run(checkpoint, out, scans, trained_on, score or [], int8, calibrate)


@app.command()
def ablate(
    config: Annotated[str, typer.Argument(help="Base: a YAML, or the name of one that ships, such as ablation_small.")],
    data: Annotated[Path, typer.Option("--data", "-d", help="KITTI-layout folder with ImageSets/{train,val}.txt.")],
    out: Annotated[Path, typer.Option("--out", "-o", help="Folder of the runs; finished ones there are kept.")],
    override: Annotated[
        list[str] | None,
        typer.Option("--set", "-s", help="key.subkey=value for every run. Repeatable: -s train.epochs=3"),
    ] = None,
    seeds: Annotated[str, typer.Option(help="Seeds of every variant, with commas between them.")] = "0,1",
    variants: Annotated[str, typer.Option(help="Names with commas between them, or all.")] = "all",
    jobs: Annotated[int, typer.Option(min=1, help="Trainings at a time; they share the CPU cores.")] = 1,
) -> None:
    """Train and compare: with and without ASP, CPA, GT-Aug and RS-Aug, other K, the readings of CPA; write one table.

    Table 5 of the paper, on equal terms and with the spread over the seeds, on whatever data you have. Goes on where it
    stopped when the same command is given again.
    """
    from asca_pillars.commands.ablate import run

    run(config, data, out, override or [], seeds, variants, jobs)


@app.command()
def doctor() -> None:
    """Say what is installed, what can run here, and what to install for the rest."""
    from asca_pillars.commands.doctor import run

    run()


if __name__ == "__main__":
    main()
