"""The rows of the pillar detectors' ablation: each goes with the base that ships."""

import pytest

from asca_pillars.ablation.variants import VARIANTS, Variant
from asca_pillars.base.settings import shipped_configs
from asca_pillars.config.pillar import PillarModel
from asca_pillars.config.tree import load_config


@pytest.mark.parametrize("variant", VARIANTS.values(), ids=lambda variant: variant.name)
def test_every_variant_fits_the_shipped_base(variant: Variant) -> None:
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


def test_a_row_that_says_nothing_of_the_loss_keeps_the_base_configuration_s() -> None:
    config = load_config("ablation_small", ("model.loss.assigner=atss", *VARIANTS["cpa_channel"].overrides))
    assert isinstance(config.model, PillarModel) and config.model.loss.assigner == "atss"
