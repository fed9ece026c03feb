"""`asca eval` as a function, and the one line with which it refuses."""

import json
from pathlib import Path
from typing import Any

import pytest

from asca_deploy.evaluate import Protocol
from asca_pillars.base.errors import AscaError
from asca_pillars.cli import eval as command


def evaluate(
    model: Path | None = None,
    *,
    out: Path,
    json_path: Path | None = None,
    gallery: int | None = 0,
    protocol: Protocol = "kitti",
    **options: Any,
) -> dict:
    """Run the command; what it wrote as JSON."""
    threads = {} if "predictions" in options else {"threads": 1}
    options = {"out": out, "json": json_path, "gallery": gallery, "protocol": protocol} | threads | options
    command.evaluate(model, **options)
    return json.loads((out / ("report.json" if protocol == "kitti" else "waymo.json")).read_text())


def refusal(tmp_path: Path, **arguments) -> str:
    with pytest.raises(AscaError) as caught:
        evaluate(**({"out": tmp_path / "out"} | arguments))
    message = str(caught.value)
    assert "\n" not in message and not (tmp_path / "out" / "report.json").exists()
    return message.replace(f"{tmp_path}/", "")
