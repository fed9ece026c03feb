"""The gate of features against its equation, and which source of an encoder it stands behind."""

import numpy as np
import torch
from numpy.typing import NDArray

from asca_pillars.models.two_stage.layers import BallSource, ContextGate, KeypointEncoder, SourceRows


def by_equation(gate: ContextGate, features: NDArray[np.float64]) -> NDArray[np.float64]:
    """1 / (1 + exp(-(W_g f + b))) * (W f), channel by channel."""
    of_gate, bias, of_value = (part.detach().numpy() for part in (gate.gate.weight, gate.gate.bias, gate.value.weight))
    gated = np.empty(features.shape)
    for keypoint, feature in enumerate(features):
        for channel in range(len(of_gate)):
            opened = 1 / (1 + np.exp(-(np.dot(of_gate[channel], feature) + bias[channel])))
            gated[keypoint, channel] = opened * np.dot(of_value[channel], feature)
    return gated


def test_a_gate_is_its_equation() -> None:
    torch.manual_seed(0)
    gate, features = ContextGate(5).double(), 3 * torch.randn(7, 5, dtype=torch.float64)
    np.testing.assert_allclose(gate(features).detach().numpy(), by_equation(gate, features.numpy()), rtol=1e-9)


def test_only_the_gated_source_goes_through_its_gate() -> None:
    torch.manual_seed(0)
    sources = [BallSource(1, 2, (6, 4)), BallSource(2, 1, (3,), gated=True), BallSource(3, 1, (2,))]
    encoder = KeypointEncoder(sources, 2, 5, weighting_channels=4).double().eval()
    rows = [SourceRows(torch.randn(9, 3).double(), torch.randn(9, source.channels).double()) for source in sources]
    keypoints, bev = torch.randn(6, 3).double(), torch.randn(6, 2).double()
    indices = [torch.randint(0, 9, (6, 4)) for _ in range(4)]
    with torch.inference_mode():
        found, logits = encoder(rows, keypoints, bev, indices)
        of_source = (0, 0, 1, 2)
        first, second, gated, last = (
            encoder.balls[ball](*rows[source], keypoints, indices[ball]) for ball, source in enumerate(of_source)
        )
        (gate,) = encoder.gates.values()
        assert isinstance(gate, ContextGate)
        gated = torch.from_numpy(by_equation(gate, gated.numpy()))
        joined = torch.cat([first, second, gated, last, bev], dim=1)
        weights = 1 / (1 + torch.exp(-encoder.weigh(joined)))
        torch.testing.assert_close(logits, encoder.weigh(joined)[:, 0])
        torch.testing.assert_close(found, weights * encoder.fuse(joined))
