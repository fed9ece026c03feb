"""Evaluation of a model, or of finished predictions, against labels."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Literal, TypeAlias

from asca_deploy.open_model import RuntimeOptions, open_model
from asca_pillars.base.errors import ConfigError
from asca_pillars.base.progress import Progress, Remark, Reporter
from asca_pillars.detection.spec import ScoreThresholds
from asca_pillars.evaluation.arguments import (
    MIN_SCORE,
    Evaluation,
    EvaluationTask,
    Model,
    check_arguments,
    default_protocol,
)

Protocol: TypeAlias = Literal["kitti", "waymo", "iou", "distance", "tracking"]
_PLAIN = RuntimeOptions()


def evaluate(
    model: str | Path | None = None,
    data: str | Path | None = None,
    out: str | Path = "evaluation",
    *,
    split: str | None = None,
    protocol: Protocol | None = None,
    predictions: str | Path | None = None,
    labels: str | Path | None = None,
    score: ScoreThresholds | None = None,
    min_score: float = MIN_SCORE,
    around: bool = False,
    gallery: int | None = None,
    compare: str | Path | None = None,
    errors: bool = False,
    errors_by: str | None = None,
    beside: Sequence[str | Path] = (),
    json: str | Path | None = None,
    options: RuntimeOptions = _PLAIN,
    progress: Progress | None = None,
    remark: Remark | None = None,
) -> Evaluation:
    """Score a model, or finished predictions, against labels; what `asca eval` does.

    Args:
        model: bundle (folder, or name of one that ships) or checkpoint; None: that of `options`.
        data: dataset whose labels count, and on which the model is run.
        out: folder for the report, curves, gallery and the model's predictions.
        split: list of frames; None: val.
        protocol: None: kitti, or iou for a dataset without a camera.
        predictions: instead of a model: folder of KITTI text, or a detections.jsonl.
        labels: folder of KITTI labels, with `predictions`; None: those of `data`.
        score: score from which on detections count for recall, precision and gallery; None: the model's.
        min_score: lowest score that the model is run with.
        around: detect in every direction, see `asca_deploy.around`.
        gallery: frames to draw; None: 8 if there are scans.
        compare: predictions of another detector, for comparison in the gallery.
        errors: also analyze the errors.
        errors_by: rows of the analysis for parts of the data, see `evaluation.errors.error_report.parts_of`.
        beside: errors.json of other evaluations, for the same tables.
        json: another file for the report's JSON.
        options: how the model runs.
        progress: called after each frame of each step.
        remark: called with each of the result's `remarks` as soon as it is known.

    Raises:
        AscaError: arguments that do not go together, files that cannot be read, or an `out` that holds something else;
            one line with the remedy.
    """
    if model is not None:
        options = replace(options, bundle=Path(model))
    chosen: Protocol = protocol or default_protocol(_path(data))
    task = EvaluationTask(
        protocol=chosen,
        model=_path(options.bundle),
        data=_path(data),
        split=split,
        predictions=_path(predictions),
        labels=_path(labels),
        out=Path(out),
        json=_path(json),
        gallery=gallery,
        compare=_path(compare),
        score=score,
        min_score=min_score,
        around=around,
        errors=errors,
        errors_by=errors_by,
        beside=tuple(map(Path, beside)),
    )
    if task.predictions is not None:
        _check_no_runtime(task.predictions, options, min_score)
    check_arguments(task)
    reporter = Reporter(progress, remark)

    def opened(sensor_height_m: float | None) -> Model:
        return open_model(options, min_score, sensor_height_m=sensor_height_m, around=around)

    if chosen == "tracking":
        from asca_pillars.evaluation.tracking_report import evaluate_tracks

        done = evaluate_tracks(task)
    elif chosen == "iou" or chosen == "distance":
        from asca_pillars.evaluation.box_evaluation import evaluate_boxes

        done = evaluate_boxes(task, chosen, opened, reporter)
    else:
        from asca_pillars.evaluation.kitti_evaluation import evaluate_text

        done = evaluate_text(task, opened, reporter)
    return replace(done, remarks=tuple(reporter.remarks))


def _path(path: str | Path | None) -> Path | None:
    return None if path is None else Path(path)


def _check_no_runtime(predictions: Path, options: RuntimeOptions, min_score: float) -> None:
    plain = RuntimeOptions()
    given = {
        f"--provider {options.provider}": options.provider != plain.provider,
        f"--precision {options.precision}": options.precision != plain.precision,
        f"--threads {options.threads}": options.threads != plain.threads,
        f"--min-score {min_score:g}": min_score != MIN_SCORE,
    }
    if options_given := [name for name, differs in given.items() if differs]:
        raise ConfigError(
            f"{options_given[0]} is for running a model; --predictions {predictions} are scored as they are"
        )
