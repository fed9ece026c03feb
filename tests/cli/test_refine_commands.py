"""A second stage through the commands, on scans without a camera."""

from pathlib import Path

import pytest
import yaml

from asca_pillars.base.errors import ConfigError
from asca_pillars.base.schema import to_dict
from asca_pillars.cli.inspect import inspect
from asca_pillars.cli.prepare import prepare
from asca_pillars.models.checkpoint import load_checkpoint
from asca_pillars.training.loop import train
from tests.data.boxes.box_scenes import write_box_dataset
from tests.helpers.scenes import write_dataset
from tests.models.two_stage.tiny_refine import tiny_refine_config, write_first_stage


def test_prepare_computes_the_proposals_that_training_reads(tmp_path: Path) -> None:
    config = tiny_refine_config(write_first_stage(tmp_path / "first.ckpt"), epochs=1)
    root, path = write_box_dataset(tmp_path / "own", 6, val_frames=2), tmp_path / "refine.yaml"
    path.write_text(yaml.safe_dump(to_dict(config)))
    prepare(path, data=root)
    files = sorted((root / "prepared" / "scans").glob("proposals-*/*.npz"))
    assert len(files) == 6
    times = [file.stat().st_mtime_ns for file in files]
    checkpoint = load_checkpoint(train(config, root, tmp_path / "run"))
    assert not checkpoint.config.data.camera_view
    assert sorted(root.rglob("proposals-*/*.npz")) == files
    assert [file.stat().st_mtime_ns for file in files] == times, "none was computed again"


def test_inspect_runs_and_proposes_nothing(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    first = write_first_stage(tmp_path / "first.ckpt")
    root, path = write_dataset(tmp_path / "data", 3), tmp_path / "refine.yaml"
    path.write_text(yaml.safe_dump(to_dict(tiny_refine_config(first))))
    inspect(root, config=path)
    assert "against tiny_refine: 2 of 2 frames" in capsys.readouterr().out
    with pytest.raises(ConfigError, match=r"--propose .*own\.yaml: classes of model.kind pillar_refine"):
        inspect(root, config=path, propose=tmp_path / "own.yaml")
    assert not (tmp_path / "own.yaml").exists()
