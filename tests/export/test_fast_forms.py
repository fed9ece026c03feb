"""Each fast form is the same function as what it replaces."""

from pathlib import Path

import onnx
import pytest
import torch
from torch import nn
from torch.nn import functional

from asca_export import graphs
from asca_export.fast_forms import STEP_VALUE, CanvasSteps, FastBackbone, FastEncoder, Upsample, fast_encoder
from asca_pillars.config.pillar import CpaReading
from tests.export.tiny import tiny_detector


def padded(image: torch.Tensor) -> torch.Tensor:
    """(1, C, ny, nx) -> the canvas (1, ny + 1, nx + 1, C) with zeros in its first row and column."""
    return functional.pad(image, (1, 0, 1, 0)).permute(0, 2, 3, 1)


@pytest.mark.parametrize("cpa", ["none", "channel", "paper", "linear"])
@torch.no_grad()
def test_the_maximum_before_bias_and_relu(cpa: CpaReading, tmp_path: Path) -> None:
    encode = tiny_detector(cpa).encode
    fast = fast_encoder(encode)
    assert isinstance(fast, FastEncoder)
    counts = torch.tensor([1, 4, 2, 32, 1])
    points = torch.randn(40, 9) * 3
    given = (points, torch.arange(5).repeat_interleave(counts), counts)
    torch.testing.assert_close(fast(*given), encode(*given), atol=1e-5, rtol=1e-5)
    graphs.export_encoder(fast, tmp_path / "encoder.onnx")
    operators = [node.op_type for node in onnx.load(tmp_path / "encoder.onnx").graph.node]
    assert operators.index("MatMul") < operators.index("ScatterND") < operators.index("Relu")


def test_an_encoder_that_needs_every_point_stays_as_it_is() -> None:
    for encode in (tiny_detector("point").encode, tiny_detector("none", empty_slots=True).encode):
        assert fast_encoder(encode) is encode


@torch.no_grad()
def test_neck_and_head() -> None:
    detector = tiny_detector("none")
    image = torch.rand(1, 16, detector.grid.ny, detector.grid.nx) - 0.3
    expected = detector.head(detector.neck(image))
    for ours, theirs in zip(FastBackbone(detector)(padded(image)), expected, strict=True):
        torch.testing.assert_close(ours.permute(0, 3, 1, 2), theirs, atol=1e-4, rtol=1e-4)


@torch.no_grad()
def test_a_canvas_in_steps_of_its_own_with_padding_that_stands_for_zero() -> None:
    detector = tiny_detector("none")
    steps = CanvasSteps(torch.rand(16) / 10 + 0.01, torch.randint(0, 256, (16,)).float())
    counted = torch.randint(0, 256, (1, 16, detector.grid.ny, detector.grid.nx)).float()
    image = steps.scale[:, None, None] * (counted - steps.empty[:, None, None])
    canvas = padded(counted)
    canvas[:, 0], canvas[:, :, 0] = steps.empty, steps.empty
    expected = detector.head(detector.neck(image))
    for ours, theirs in zip(FastBackbone(detector, steps)(canvas * STEP_VALUE), expected, strict=True):
        torch.testing.assert_close(ours.permute(0, 3, 1, 2), theirs, atol=1e-3, rtol=1e-3)


@pytest.mark.parametrize("stride", [1, 2, 4])
@torch.no_grad()
def test_depth_to_space_is_the_transposed_convolution(stride: int) -> None:
    deblock = nn.Sequential(nn.ConvTranspose2d(5, 3, stride, stride, bias=False), nn.BatchNorm2d(3), nn.ReLU()).eval()
    features = torch.randn(1, 5, 6, 7)
    torch.testing.assert_close(Upsample(deblock)(features).permute(0, 3, 1, 2), deblock(features))


def test_the_detector_stays_as_it_was() -> None:
    detector = tiny_detector("none")
    before = {name: value.clone() for name, value in detector.state_dict().items()}
    fast_encoder(detector.encode)
    FastBackbone(detector, CanvasSteps(torch.full((16,), 0.1), torch.full((16,), 9.0)))
    assert all(torch.equal(before[name], value) for name, value in detector.state_dict().items())
    assert detector.neck.get_submodule("blocks.0.0").padding == (1, 1)


def test_multiply_accumulates_are_those_of_the_shapes(tmp_path: Path) -> None:
    detector = tiny_detector("none")
    graphs.export_backbone(FastBackbone(detector), detector.grid.map_shape, tmp_path / "backbone.onnx")
    cells = detector.grid.ny * detector.grid.nx
    blocks = [  # (cells of the output, inputs, outputs, convolutions): one strided and one plain convolution each
        cells // 4 * 9 * (16 * 16 + 16 * 16),
        cells // 16 * 9 * (16 * 24 + 24 * 24),
        cells // 64 * 9 * (24 * 32 + 32 * 32),
    ]
    upsamples = [cells // 4 * 16 * 16, cells // 16 * 24 * 16 * 4, cells // 64 * 32 * 16 * 16]
    head = cells // 4 * 48 * (6 + 42 + 12)
    assert graphs.multiply_accumulates(tmp_path / "backbone.onnx") == sum(blocks) + sum(upsamples) + head
