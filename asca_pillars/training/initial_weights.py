"""Weights that a new run starts from instead of random ones: `asca train --init`, `asca ablate --init`."""

from pathlib import Path
from typing import Any

from asca_pillars.base.errors import TrainingError
from asca_pillars.config.pv_rcnn import PvRcnnModel
from asca_pillars.config.tree import Config
from asca_pillars.models.build import build_model
from asca_pillars.models.checkpoint import load_checkpoint

_FIRST_STAGE = tuple(f"network.{part}." for part in PvRcnnModel.FIRST_STAGE)


def initial_weights(config: Config, init: Path | None) -> dict[str, Any]:
    """What a new run of `config` takes from `init`, by the names of `state_dict`; the rest starts at random.

    All weights, but where `model.train_first_stage` is false, those of the first stage alone.

    Args:
        config: of the run.
        init: a checkpoint; None for none.

    Raises:
        TrainingError: they are not of this configuration's network, or none are given to a first stage that is not
            trained.
    """
    alone = isinstance(config.model, PvRcnnModel) and not config.model.train_first_stage
    if init is None:
        if alone:
            raise TrainingError(
                "model.train_first_stage = false: a first stage that is not trained has to come from somewhere; give "
                "the checkpoint or bundle of a trained one with --init"
            )
        return {}
    theirs, ours = (
        {name: array for name, array in weights.items() if not alone or name.startswith(_FIRST_STAGE)}
        for weights in (load_checkpoint(init).detector.state_dict(), build_model(config.model).state_dict())
    )
    for name in ours | theirs:
        found, wanted = (tuple(each[name].shape) if name in each else "missing" for each in (theirs, ours))
        if found != wanted:
            raise TrainingError(
                f"{init}: weights of another network: {name} is {found} there and {wanted} in this configuration; "
                "model.spec and model.network have to be like those that it was trained with"
            )
    return theirs
