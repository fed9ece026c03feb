"""Networks that differ in anything that a graph shows are never taken for each other."""

import torch
from torch import nn

from tests.helpers.kept_exports import digest

EXAMPLE = (torch.zeros(2, 3),)


def network(seed: int = 0, slope: float = 0.1) -> nn.Module:
    torch.manual_seed(seed)
    return nn.Sequential(nn.Linear(3, 4), nn.LeakyReLU(slope))


def test_weights_settings_shapes_and_options_count_and_values_of_the_example_do_not() -> None:
    options = {"dynamic_shapes": ({0: torch.export.Dim("rows")},)}
    one = digest(network(), EXAMPLE, options)
    assert one == digest(network(), (torch.ones(2, 3),), {"dynamic_shapes": ({0: torch.export.Dim("rows")},)})
    others = [
        digest(network(seed=1), EXAMPLE, options),
        digest(network(slope=0.2), EXAMPLE, options),
        digest(network(), (torch.zeros(1, 3),), options),
        digest(network(), EXAMPLE, {"dynamic_shapes": ({0: 2 * torch.export.Dim("rows")},)}),
        digest(network(), EXAMPLE, {}),
    ]
    assert len({one, *others}) == 6
