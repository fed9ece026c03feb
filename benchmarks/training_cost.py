"""Cost of a training sample: in the loading processes and in the network, and the machine's training rate.

    asca simulate data/sim --frames 400 --view camera
    asca prepare asca_sim --data data/sim
    python -m benchmarks.training_cost asca_sim --data data/sim

Samples are drawn as in `asca train`, including augmentation and insertion, in one process; a step is forward,
loss and backward on `--device`. Medians over the batches, with quartiles, in processor time (all threads
together); for a step on a device other than a CPU in wall time.
"""

import time
from dataclasses import replace
from pathlib import Path
from typing import Annotated

import numpy as np
import torch
import typer
from rich.progress import track

from asca_pillars.base.system import cpu_model
from asca_pillars.cli.run_command import run_command
from asca_pillars.config.tree import load_config
from asca_pillars.config.two_stage import RefineModel
from asca_pillars.evaluation.report_page import markdown_table
from asca_pillars.models.build import build_model
from asca_pillars.models.trainable import to_device
from asca_pillars.models.two_stage.first_stage import with_first_stage
from asca_pillars.training.dataset import open_dataset
from asca_pillars.training.module import resolve_precision

WARM_UP = 3


def main(
    config: Annotated[str, typer.Argument(help="YAML of the model, or the name of one that ships.")],
    data: Annotated[Path, typer.Option(help="Dataset, prepared.")],
    batches: Annotated[int, typer.Option(help="Batches to time.")] = 60,
    device: Annotated[str, typer.Option(help="Of the network: cpu or cuda.")] = "cpu",
    override: Annotated[list[str] | None, typer.Option("--set", "-s", help="As of `asca train`.")] = None,
) -> None:
    """Print milliseconds per sample of loading and of a step."""
    settings = load_config(config, override or ())
    if isinstance(settings.model, RefineModel):
        settings = replace(settings, model=with_first_stage(settings.model))
    frames = open_dataset(data, settings, training=True)
    model = build_model(settings.model).to(device)
    model.train()
    optimizer = torch.optim.Adam(model.parameters(), lr=settings.train.learning_rate)
    size, in_bfloat16 = settings.train.batch_size, resolve_precision(settings.train.precision, device) == "bf16"
    clock = time.process_time if device == "cpu" else time.perf_counter  # other jobs on a CPU do not count
    loading, stepping = [], []
    for number in track(range(batches + WARM_UP), "Measuring"):
        start = time.process_time()
        samples = [frames.sample(0, (number * size + index) % len(frames)) for index in range(size)]
        inputs = frames.preparation.collate([sample.prepared for sample in samples])
        loaded = time.process_time()
        begin = clock()
        inputs = to_device(inputs, device)
        with torch.autocast(torch.device(device).type, torch.bfloat16, enabled=in_bfloat16):
            loss = torch.stack(list(model.loss(model.predict(inputs), inputs).values())).sum()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        if device != "cpu":
            torch.cuda.synchronize()
        stepping.append(clock() - begin)
        loading.append(loaded - start)
    rows = []
    for title, seconds in (("loading", loading), ("step", stepping)):
        low, median, high = np.percentile(1e3 * np.array(seconds[WARM_UP:]) / size, (25, 50, 75))
        rows.append((title, f"{median:.1f}", f"{low:.1f} to {high:.1f}", f"{1e3 / median:.0f}"))
    arithmetic = "bf16" if in_bfloat16 else "fp32"
    print(f"{cpu_model()}; {torch.get_num_threads()} threads; network on {device} in {arithmetic}\n")
    print(markdown_table(("", "ms per sample", "quartiles", "samples per second and process"), rows, left=1))


if __name__ == "__main__":
    run_command(main)
