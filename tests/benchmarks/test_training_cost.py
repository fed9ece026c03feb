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


def test_both_parts_of_a_sample_are_timed(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    config = write(tmp_path, yaml.safe_dump(to_dict(CONFIG)))
    main(str(config), write_dataset(tmp_path / "data", 2), batches=2)
    rows = re.findall(r"\| (loading|step) \| ([\d.]+) \|", capsys.readouterr().out)
    assert [title for title, _ in rows] == ["loading", "step"]
    assert all(float(milliseconds) > 0 for _, milliseconds in rows)
