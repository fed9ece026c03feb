"""What cannot be the first stage of two is refused, as a checkpoint and as a bundle."""

import dataclasses
from pathlib import Path

import pytest

from asca_export.exporter import export_bundle
from asca_pillars.errors import ConfigError
from asca_pillars.models.checkpoint import Checkpoint
from asca_pillars.models.second_stage.open_first_stage import open_first_stage
from asca_pillars.points.first_stage import require_dense_map
from tests.export.tiny import SCANS, tiny_checkpoint
from tests.models.second_stage.tiny_refine import save_checkpoint
from tests.scenes import SPEC

POOLED = dataclasses.replace(SPEC, grid=dataclasses.replace(SPEC.grid, map="pooled"))


@pytest.mark.parametrize(
    ("checkpoint", "message"),
    [
        (tiny_checkpoint("none", neck="sparse"), "a sparse neck on a warped map; a first stage has a dense neck"),
        (tiny_checkpoint("none", POOLED), "a dense neck on a pooled map; a first stage has a dense neck"),
    ],
    ids=["sparse", "pooled"],
)
def test_only_a_dense_neck_on_a_warped_map(tmp_path: Path, checkpoint: Checkpoint, message: str) -> None:
    save_checkpoint(tmp_path / "first.ckpt", checkpoint)
    export_bundle(checkpoint, tmp_path / "bundle", SCANS)
    for source in ("first.ckpt", "bundle"):
        with pytest.raises(ConfigError, match=f"{source}: {message}"):
            open_first_stage(str(tmp_path / source))


def test_two_stages_are_no_first_stage() -> None:
    with pytest.raises(ConfigError, match=r"a_bundle: model.kind pillar_refine; a first stage is of kind pillar"):
        require_dense_map("a_bundle", "pillar_refine", "dense", pooled=False)
