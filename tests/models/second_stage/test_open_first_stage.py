"""What cannot be the first stage of two is refused, as a checkpoint and as a bundle."""

import dataclasses
from pathlib import Path

import pytest

from asca_deploy.manifest import load_bundle
from asca_pillars.errors import ConfigError
from asca_pillars.models.checkpoint import Checkpoint
from asca_pillars.models.second_stage.open_first_stage import open_first_stage
from asca_pillars.pillar_config import PillarModel
from asca_pillars.points.first_stage import require_dense_map
from tests.deploy.conftest import sign, write_bundle
from tests.export.tiny import tiny_checkpoint
from tests.models.second_stage.tiny_refine import save_checkpoint
from tests.scenes import SPEC

POOLED = dataclasses.replace(SPEC, grid=dataclasses.replace(SPEC.grid, map="pooled"))


def write_as(checkpoint: Checkpoint, folder: Path) -> None:
    """A bundle with the neck and the map of `checkpoint`; its graphs are others, and are not looked at."""
    model = checkpoint.config.model
    assert isinstance(model, PillarModel)
    bundle = load_bundle(write_bundle(folder))
    cells = model.network.active_cells if model.network.neck == "sparse" else None
    pillar = dataclasses.replace(bundle.pillar, neck=model.network.neck, active_cells=cells)
    spec = dataclasses.replace(bundle.spec, grid=dataclasses.replace(bundle.spec.grid, map=model.spec.grid.map))
    sign(folder, dataclasses.replace(bundle, spec=spec, pillar=pillar))


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
    write_as(checkpoint, tmp_path / "bundle")
    for source in ("first.ckpt", "bundle"):
        with pytest.raises(ConfigError, match=f"{source}: {message}"):
            open_first_stage(str(tmp_path / source))


def test_two_stages_are_no_first_stage() -> None:
    with pytest.raises(ConfigError, match=r"a_bundle: model.kind pillar_refine; a first stage is of kind pillar"):
        require_dense_map("a_bundle", "pillar_refine", "dense", pooled=False)
