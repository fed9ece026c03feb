"""Rows of both ablations: each goes with the base that ships, and one of two stages goes through to the table."""

import dataclasses
import shutil
from pathlib import Path
from typing import Any

import pytest
import torch
import yaml

from asca_pillars.ablation.variants import BASE, TWO_STAGE, VARIANTS, Variant
from asca_pillars.base.errors import ConfigError, TrainingError
from asca_pillars.base.schema import to_dict
from asca_pillars.base.settings import shipped_configs
from asca_pillars.cli.ablate import ablate
from asca_pillars.cli.ablate_steps import check, family_of, parse_variants
from asca_pillars.config.pillar import PillarModel
from asca_pillars.config.pv_rcnn import PvRcnnModel
from asca_pillars.config.tree import load_config
from asca_pillars.models.build import build_model, load_checkpoint
from asca_pillars.training.loop import train
from tests.helpers.bundles import PV_RCNN
from tests.helpers.scenes import write_dataset
from tests.models.pv_rcnn.tiny_pv_rcnn import MODEL, NETWORK, SETTINGS, tiny_config


@pytest.mark.parametrize("variant", VARIANTS.values(), ids=lambda variant: variant.name)
def test_every_pillar_variant_fits_the_shipped_base(variant: Variant) -> None:
    config = load_config(shipped_configs()["ablation_small"], variant.overrides)
    assert isinstance(config.model, PillarModel)
    assert config.model.spec.grid.zones == variant.zones and config.model.network.cpa == variant.cpa
    assert config.augment.insert.method == variant.insert
    grid, along_m = config.model.spec.grid, 0.16 if variant.zones == 1 else 0.32
    assert (grid.v_max_m, grid.v_y_m) == ((0.08, 0.08) if variant.fine_pillars else (along_m, 0.16))
    assert config.model.spec.grid.map == variant.map and config.model.network.neck == variant.neck
    car, *persons = config.model.spec.classes
    assert (car.positive_iou, car.negative_iou) == (0.6, 0.45)
    assert {(spec.positive_iou, spec.negative_iou) for spec in persons} == {variant.person_ious or (0.5, 0.35)}
    assert config.model.loss.assigner == ("atss" if "atss" in variant.name else "overlap")
    assert config.model.loss.score_target == ("iou" if "iou_score" in variant.name else "one")
    if variant.name == "cpa_channel":  # a row that says nothing of the loss keeps the base configuration's
        config = load_config("ablation_small", ("model.loss.assigner=atss", *variant.overrides))
        assert isinstance(config.model, PillarModel) and config.model.loss.assigner == "atss"


FEW_BALLS = dataclasses.replace(  # each takes its share of the export
    MODEL,
    settings=dataclasses.replace(SETTINGS, sources=SETTINGS.sources[::2], grid_radii_m=(1.6,)),
    network=dataclasses.replace(NETWORK, source_widths=NETWORK.source_widths[::2]),
)


def model_of(*overrides: str) -> PvRcnnModel:
    model = load_config(BASE, overrides).model
    assert isinstance(model, PvRcnnModel)
    return model


@pytest.mark.parametrize("name", TWO_STAGE.variants)
def test_every_variant_fits_the_shipped_base_and_is_another_network(name: str) -> None:
    row = TWO_STAGE.variants[name]
    model = model_of(*row.overrides)
    weights = sum(weight.numel() for weight in build_model(model).parameters())
    assert 100_000 < weights < 1_500_000
    baseline = TWO_STAGE.variants["pv_rcnn"]
    assert (model == model_of(*baseline.overrides)) == (row == baseline)
    assert len(row.components) == len(TWO_STAGE.components)
    assert [other for other in TWO_STAGE.variants.values() if other.components == row.components] == [row]


def test_msaa_takes_the_place_of_the_points_alone_and_every_row_is_in_a_table() -> None:
    base, scales = model_of(), model_of(*TWO_STAGE.variants["msaa"].overrides)
    assert base == model_of(*TWO_STAGE.variants["pv_rcnn"].overrides)
    assert base.settings.sources[0].source == "points"
    assert scales.settings.sources == base.settings.sources[1:]
    assert scales.network.source_widths == base.network.source_widths[1:]
    assert scales.settings.scale_radii_m and not base.settings.scale_radii_m
    assert {name for names in TWO_STAGE.tables.values() for name in names} == set(TWO_STAGE.variants)


def test_names_are_those_of_the_base_s_family() -> None:
    with pytest.raises(ConfigError, match="--variants asp_k3: no such variant; available: pv_rcnn, deform_paper"):
        parse_variants("asp_k3", family_of(load_config(BASE)))
    with pytest.raises(
        ConfigError, match=r"model\.kind = pillar_refine: no variants; give a base of kind pillar or pv_rcnn"
    ):
        family_of(load_config("asca_refine_sim"))


@pytest.mark.parametrize(
    ("config", "row", "message"),
    [
        ("pv_rcnn_kitti", "msaa", "states other sources than the base has"),
        ("no_sources", "gate", "has balls of raw points, which the base has not"),
        ("afe_rcnn_kitti", "gate", "has balls of raw points, which the base has not"),
    ],
)
def test_a_base_that_a_row_would_change_otherwise_is_refused(config: str, row: str, message: str) -> None:
    overrides = ("model.settings.sources=[]", "model.network.source_widths=[]") if config == "no_sources" else ()
    with pytest.raises(ConfigError, match=f"--variants {row}: {message}"):
        check([TWO_STAGE.variants[row]], BASE if overrides else config, overrides, Path("nowhere"))


@pytest.mark.usefixtures("in_turn")
def test_from_training_to_the_table(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    # Its own graphs would take ten seconds; what is exported of a row is tested in tests/export.
    monkeypatch.setattr("asca_export.export.export_bundle", lambda _, folder, __: shutil.copytree(PV_RCNN, folder))
    data, base = write_dataset(tmp_path / "data", 10, val_frames=8), tmp_path / "tiny.yaml"
    config = tiny_config(FEW_BALLS, epochs=1)
    base.write_text(yaml.safe_dump(to_dict(config)))
    first = train(config, data, tmp_path / "first")
    options: dict[str, Any] = {
        "data": data,
        "out": tmp_path / "out",
        "seeds": "0",
        "override": ["model.train_first_stage=false"],
        "init": first,
    }
    with pytest.raises(
        TrainingError, match=r"--variants rda: .*: weights of another network: network\.neck\.attention"
    ):
        ablate(str(base), variants="deform_gate,rda", **options)
    assert not (tmp_path / "out").exists()
    ablate(str(base), variants="deform_gate", **options)
    text = (tmp_path / "out" / "results.md").read_text()
    assert "| paper | yes | balls | - | balls | - | 512 |" in text and "2 frames for training" in text
    assert "(AV PV-RCNN, Tables 5 and 6)" in text and "AFE-RCNN" not in text
    trained = tmp_path / "out" / "deform_gate" / "seed0" / "checkpoints" / "last.ckpt"
    voxels = [
        load_checkpoint(path).detector.state_dict()["network.voxels.down.0.convolution.weight"]
        for path in (first, trained)
    ]
    assert torch.equal(*voxels), "of the first stage that was given"
    with pytest.raises(TrainingError, match="another base configuration or data"):
        ablate(str(base), variants="deform_gate", **(options | {"init": trained}))
