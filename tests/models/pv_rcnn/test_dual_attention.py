"""Dual attention against its equations, place by place."""

import numpy as np
import pytest
import torch

from asca_pillars.models.pv_rcnn.layers import DualAttention


def by_hand(module: DualAttention, features: np.ndarray) -> np.ndarray:
    """Eq. (1)-(4) on one map (C, H, W), with loops over places."""

    def at(layer: torch.nn.Conv2d, value: np.ndarray) -> np.ndarray:
        bias = 0.0 if layer.bias is None else layer.bias.detach().numpy()
        return np.asarray(layer.weight[:, :, 0, 0].detach().numpy() @ value + bias)

    places = [tuple(place) for place in np.ndindex(*features.shape[1:])]
    scores = np.array([at(module.channel_query, features[:, y, x])[0] for y, x in places])
    shares = np.exp(scores - scores.max()) / np.exp(scores - scores.max()).sum()
    pooled = sum(
        share * at(module.channel_value, features[:, y, x]) for share, (y, x) in zip(shares, places, strict=True)
    )
    out, norm = module.channel_out, module.channel_norm
    wide = out.weight.detach().numpy() @ pooled + out.bias.detach().numpy()
    normed = (wide - wide.mean()) / np.sqrt(wide.var() + norm.eps)
    weights = 1 / (1 + np.exp(-(normed * norm.weight.detach().numpy() + norm.bias.detach().numpy())))
    attended = features * weights[:, None, None]
    query = np.mean([at(module.place_query, attended[:, y, x]) for y, x in places], axis=0)
    shares = np.exp(query - query.max()) / np.exp(query - query.max()).sum()
    result = np.empty_like(attended)
    for y, x in places:
        weight = 1 / (1 + np.exp(-(shares @ at(module.place_value, attended[:, y, x]))))
        result[:, y, x] = weight * attended[:, y, x]
    return result


@pytest.mark.parametrize("residual", [True, False])
def test_it_is_what_the_equations_say(residual: bool) -> None:
    torch.manual_seed(0)
    module = DualAttention(6, residual=residual).double()
    features = torch.randn(2, 6, 3, 4, dtype=torch.float64)
    with torch.inference_mode():
        found = module(features).numpy()
    for one, expected in zip(found, features.numpy(), strict=True):
        attended = by_hand(module, expected)
        np.testing.assert_allclose(one, expected + 0.1 * attended if residual else attended, atol=1e-9)
