"""The configuration of a run that takes seconds."""

import dataclasses

from asca_pillars.config.pillar import NetworkConfig, PillarModel
from asca_pillars.config.tree import Config, DataConfig, TrainConfig
from tests.helpers.scenes import SPEC

NETWORK = NetworkConfig(pillar_channels=16, block_channels=(16, 24, 32), block_convs=(1, 1, 1), upsample_channels=16)
CONFIG = Config(
    name="tiny",
    model=PillarModel(spec=SPEC, network=NETWORK),
    data=DataConfig(workers=0),
    train=TrainConfig(epochs=2, batch_size=2, learning_rate=1e-3, checkpoint_steps=1),
)


def with_train(**changes: object) -> Config:
    return dataclasses.replace(CONFIG, train=dataclasses.replace(CONFIG.train, **changes))  # type: ignore[arg-type]
