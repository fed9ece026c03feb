"""`asca eval` as a function, and the one line with which it refuses."""

import json
from pathlib import Path

import pytest

from asca_deploy.evaluate import Protocol
from asca_pillars.base.errors import AscaError
from asca_pillars.cli import eval as command


def evaluate(
    model: Path | None = None,
    *,
    data: Path | None = None,
    predictions: Path | None = None,
    labels: Path | None = None,
    out: Path,
    json_path: Path | None = None,
    gallery: int | None = 0,
    compare: Path | None = None,
    score: list[str] | None = None,
    min_score: float = 0.05,
    provider: str = "cpu",
    precision: str | None = None,
    threads: int | None = 1,
    protocol: Protocol = "kitti",
    split: str | None = None,
) -> dict:
    """Run the command; what it wrote as JSON."""
    command.evaluate(
        model,
        data=data,
        split=split,
        predictions=predictions,
        labels=labels,
        out=out,
        json=json_path,
        gallery=gallery,
        compare=compare,
        score=score,
        min_score=min_score,
        protocol=protocol,
        provider=provider,
        precision=precision,
        threads=threads if predictions is None else None,
    )
    return json.loads((out / ("report.json" if protocol == "kitti" else "waymo.json")).read_text())


def refusal(tmp_path: Path, **arguments) -> str:
    with pytest.raises(AscaError) as caught:
        evaluate(**({"out": tmp_path / "out"} | arguments))
    message = str(caught.value)
    assert "\n" not in message and not (tmp_path / "out" / "report.json").exists()
    return message.replace(f"{tmp_path}/", "")
