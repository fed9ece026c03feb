"""A bundle as first stage against the checkpoint that it was exported from."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import onnx
import pytest
import torch

from asca_export.bundle_first_stage import BundleFirstStage
from asca_export.neck_output import add_neck_output
from asca_pillars.errors import ExportError
from asca_pillars.models.second_stage.checkpoint_first_stage import CheckpointFirstStage
from asca_pillars.pillar_config import CpaReading
from asca_pillars.schema import to_dict
from tests.export.tiny import NETWORK, SCANS, tiny_checkpoint


def test_says_what_the_checkpoint_says(exported: Callable[[CpaReading], Path], tmp_path: Path) -> None:
    checkpoint = tiny_checkpoint("channel")
    weights = {f"detector.{name}": value for name, value in checkpoint.detector.state_dict().items()}
    content = {
        "hyper_parameters": {"config": to_dict(checkpoint.config)},
        "state_dict": weights,
        "global_step": 0,
    }
    torch.save(content, tmp_path / "last.ckpt")
    in_torch, in_onnx = CheckpointFirstStage(tmp_path / "last.ckpt"), BundleFirstStage(exported("channel"))
    assert in_torch.spec == in_onnx.spec
    assert in_torch.identity != in_onnx.identity
    wanted, found = in_torch(SCANS[0]), in_onnx(SCANS[0])
    rows, columns = in_torch.spec.anchors.shape[:2]
    assert found.neck.shape == (rows, columns, 3 * NETWORK.upsample_channels)
    np.testing.assert_allclose(found.neck, wanted.neck, atol=1e-4)
    for one, other in zip(found.maps, wanted.maps, strict=True):
        np.testing.assert_allclose(one, other, atol=1e-3)


def test_refuses_a_graph_without_a_map_in_floating_point() -> None:
    value = onnx.helper.make_tensor_value_info("x", onnx.TensorProto.UINT8, [1, 2, 2, 4])
    other = onnx.helper.make_tensor_value_info("y", onnx.TensorProto.UINT8, [1, 2, 2, 8])
    nodes = [
        onnx.helper.make_node("Concat", ["x", "x"], ["joined"], axis=3),
        onnx.helper.make_node("Identity", ["joined"], ["y"]),
    ]
    for chosen in (nodes, [onnx.helper.make_node("Tile", ["x", "n"], ["y"])]):
        model = onnx.helper.make_model(onnx.helper.make_graph(chosen, "backbone", [value], [other]))
        with pytest.raises(ExportError, match="float32"):
            add_neck_output(model)
