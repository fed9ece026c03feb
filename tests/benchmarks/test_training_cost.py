"""The benchmark of a training sample, run in small."""

import re
from pathlib import Path

import pytest
import yaml

from asca_pillars.base.schema import to_dict
from benchmarks.training_cost import main
from tests.helpers.config_files import write
from tests.helpers.scenes import write_dataset
from tests.helpers.tiny_run import CONFIG
from tests.models.two_stage.tiny_refine import tiny_refine_config, write_first_stage


def test_both_parts_of_a_sample_are_timed(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Also of a second stage, whose proposals are computed first."""
    data = write_dataset(tmp_path / "data", 2)
    for config in (CONFIG, tiny_refine_config(write_first_stage(tmp_path / "first.ckpt"), epochs=1)):
        main(str(write(tmp_path, yaml.safe_dump(to_dict(config)))), data, batches=2)
        rows = re.findall(r"\| (loading|step) \| ([\d.]+) \|", capsys.readouterr().out)
        assert [title for title, _ in rows] == ["loading", "step"]
        assert all(float(milliseconds) > 0 for _, milliseconds in rows)
