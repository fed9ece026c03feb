"""What `asca export` reads beside the checkpoint: what the run wrote of itself, or one line that says what is wrong."""

import json
from pathlib import Path

import pytest

from asca_export.export_checkpoint import open_source, run_environment
from asca_pillars.base.errors import TrainingError
from asca_pillars.base.system import describe_environment
from tests.export.tiny import tiny_checkpoint
from tests.helpers.saved_checkpoint import save_checkpoint


@pytest.fixture
def checkpoint(tmp_path: Path) -> Path:
    return tmp_path / "run" / "checkpoints" / "last.ckpt"


def test_the_folder_of_a_run_s_checkpoints_is_its_weights(checkpoint: Path) -> None:
    checkpoint.parent.mkdir(parents=True)
    save_checkpoint(checkpoint.with_name("weights.ckpt"), tiny_checkpoint("none"))
    source = open_source(checkpoint.parent)
    assert source.path == checkpoint.with_name("weights.ckpt") and source.shipped_as is None


def test_the_command_of_the_run_is_known(checkpoint: Path) -> None:
    assert run_environment(checkpoint) == {}, "the checkpoint lies elsewhere"
    checkpoint.parent.mkdir(parents=True)
    (checkpoint.parents[1] / "environment.json").write_text(json.dumps(describe_environment()))
    assert isinstance(run_environment(checkpoint)["command"], str)


@pytest.mark.parametrize("content", [b"", b'{"command": ', b"[]", b'{"command": 3}', b"\xff\xfe", b"NaN"])
def test_a_damaged_file_is_one_line_with_the_remedy(checkpoint: Path, content: bytes) -> None:
    checkpoint.parent.mkdir(parents=True)
    path = checkpoint.parents[1] / "environment.json"
    path.write_bytes(content)
    with pytest.raises(TrainingError) as caught:
        run_environment(checkpoint)
    assert str(caught.value).startswith(f"{path}: not what `asca train` wrote")
    assert "delete it" in str(caught.value) and "\n" not in str(caught.value)
