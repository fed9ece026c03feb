"""The code blocks of a page of the documentation, and a folder with the files that the pages speak of."""

import functools
import json
import re
import shlex
import subprocess
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from typer.testing import CliRunner

from asca_deploy import sample_scan_path
from asca_pillars.cli.main import app
from asca_pillars.data.boxes.box_records import json_line, read_frames
from asca_pillars.models.build import Checkpoint, build_model
from asca_pillars.scans.scan_reader import read_scan, write_scan
from benchmarks.made_recordings import point_cloud2
from tests.data.boxes.box_scenes import write_box_dataset
from tests.helpers.saved_checkpoint import save_checkpoint
from tests.helpers.scenes import write_dataset
from tests.helpers.tiny_run import CONFIG
from tests.models.openpcdet import mmdetection3d_networks
from tests.models.openpcdet.foreign_networks import PointPillars, write_foreign
from tests.scans.recordings.cloud_recordings import stamps, store, write_mcap

DOCS = Path(__file__).parents[2] / "docs"
_BLOCK = re.compile(
    r"(?: *<!-- not run: (?P<reason>[^\n]+?) -->\n)?(?P<indent> *)```(?P<language>\w+)\n(?P<code>.*?)\n(?P=indent)```",
    re.DOTALL,
)


@dataclass(frozen=True)
class Block:
    """A fenced block of a page."""

    language: str
    code: str
    line: int
    reason: str | None
    """Why it is not run; None if it is."""

    @property
    def commands(self) -> list[str]:
        """Lines of a shell, those joined that a backslash continues."""
        return [line for line in self.code.replace("\\\n", " ").splitlines() if line.strip()]


def blocks(page: Path) -> Iterator[Block]:
    """The bash and python blocks of a page, in order."""
    text = page.read_text(encoding="utf-8")
    for match in _BLOCK.finditer(text):
        if match["language"] in ("bash", "python"):
            indent = match["indent"]
            code = "\n".join(line.removeprefix(indent) for line in match["code"].splitlines())
            yield Block(match["language"], code, text.count("\n", 0, match.start("language")) + 1, match["reason"])


@functools.cache
def help_of(command: str) -> str:
    """What `asca COMMAND --help` prints."""
    result = CliRunner().invoke(app, [command, "--help"], env={"COLUMNS": "200"})
    assert result.exit_code == 0, command
    return result.output


def run(block: Block, page: str) -> None:
    """Run a block in the working directory; `asca` runs in this process."""
    if block.language == "python":
        exec(compile("\n" * (block.line - 1) + block.code, page, "exec"), {"__name__": "__main__"})
        return
    for command in block.commands:
        if command.startswith("asca "):
            result = CliRunner().invoke(app, shlex.split(command, comments=True)[1:], catch_exceptions=False)
            assert result.exit_code == 0, f"{page}:{block.line}: {command}\n{result.output}"
        else:
            subprocess.run(["bash", "-ec", command], check=True, timeout=60, stdout=subprocess.DEVNULL)


def write_files(root: Path) -> None:
    """What the pages take for granted: scans of several kinds, datasets, predictions and a checkpoint, all small."""
    points = read_scan(sample_scan_path()).points[::2]
    for name in ("scan.bin", "my_scans/1.bin", "sweeps/1.bin"):
        write_scan(root / name, points)
    write_scan(root / "my_scans" / "2.bin", points[::2])
    made = store()
    write_mcap(root / "drive.mcap", {"/points": [(time, point_cloud2(made, time, points[::4])) for time in stamps(2)]})
    rings = np.arange(len(points)) % 64
    np.column_stack([points[:, :3], np.round(points[:, 3:] * 255), rings]).astype("<f4").tofile(root / "sweep.bin")
    (root / "lidar_to_vehicle.txt").write_text("1 0 0 0\n0 1 0 0\n0 0 1 1.4\n0 0 0 1\n")

    own = write_box_dataset(root / "data" / "own", 13)
    (root / "recordings").symlink_to(own / "scans")
    frames = list(read_frames(own / "labels.jsonl"))
    (root / "boxes.csv").write_text("scan,class,x,y,z,length,width,height,yaw\n" + "".join(map(_rows, frames)))
    scored = [frame.records._replace(scores=frame.records.scores * 0 + 0.9) for frame in frames]
    (root / "results").mkdir()
    lines = [_detected(json_line(frame.scan, records)) for frame, records in zip(frames, scored, strict=True)]
    (root / "results" / "detections.jsonl").write_text("".join(lines))

    for name in ("kitti", "sim", "around"):
        write_dataset(root / "data" / name, 2)
    labels = root / "data" / "kitti" / "training" / "label_2"
    (root / "label_2").symlink_to(labels)
    for folder in ("predictions", "my_detector"):
        (root / folder).mkdir()
        for path in labels.iterdir():
            (root / folder / path.name).write_text("".join(f"{line} 0.9\n" for line in path.read_text().splitlines()))

    torch.manual_seed(0)
    untrained = Checkpoint(CONFIG, build_model(CONFIG.model), 7)
    for name in ("own", "small"):
        checkpoint = root / "runs" / name / "checkpoints" / "last.ckpt"
        checkpoint.parent.mkdir(parents=True)
        save_checkpoint(checkpoint, untrained)
    published = 64, (64, 128, 256), (3, 5, 5), 128, 3
    write_foreign(root / "pointpillar.pth", PointPillars(*published).state_dict())
    theirs = mmdetection3d_networks.PointPillars(*published)
    mmdetection3d_networks.write_mmdetection3d(root / "hv_pointpillars_3class.pth", theirs.state_dict())


def _rows(frame: Any) -> str:
    line = json.loads(json_line(frame.scan, frame.records))
    keys = ("x_m", "y_m", "z_m", "length_m", "width_m", "height_m", "yaw_rad")
    return "".join(f"{frame.scan},{box['class']},{','.join(str(box[key]) for key in keys)}\n" for box in line["boxes"])


def _detected(line: str) -> str:
    """As `asca detect` writes a line."""
    frame = {**json.loads(line), "points_not_finite": 0}
    return json.dumps({**frame, "boxes": [{**box, "score": 0.9} for box in frame["boxes"]]}) + "\n"
