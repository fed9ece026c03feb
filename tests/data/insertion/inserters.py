"""Inserters of every method on simple streets."""

import dataclasses

from asca_pillars.config.pillar import PillarModel
from asca_pillars.config.tree import Config, DataConfig, InsertConfig
from asca_pillars.data.frames import LabeledSplit
from asca_pillars.data.insertion.insert_objects import Inserter, prepare_inserter
from tests.helpers.scenes import SPEC

METHODS = ("gt_aug", "rs_aug")


def config(method: str, **insert: object) -> Config:
    base = Config(model=PillarModel(spec=SPEC), data=DataConfig(workers=0))
    changed = InsertConfig(method=method, **insert)  # type: ignore[arg-type]
    return dataclasses.replace(base, augment=dataclasses.replace(base.augment, insert=changed))


def open_inserter(split: LabeledSplit, settings: Config) -> Inserter:
    return prepare_inserter(split, settings.model.spec, settings.data, settings.augment.insert)
