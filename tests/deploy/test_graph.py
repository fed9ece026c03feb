from dataclasses import replace
from pathlib import Path

import numpy as np
import onnx
import pytest
from numpy.typing import NDArray

from asca_deploy import Detector
from asca_deploy.manifest import load_pillar_bundle
from asca_deploy.providers import Provider
from asca_pillars.base.errors import BundleError
from tests.deploy.conftest import needs_openvino, sign
from tests.deploy.corrupt_graph import corrupt_graph

by_provider = pytest.mark.parametrize("provider", ["cpu", pytest.param("openvino", marks=needs_openvino)])


def rename(model: onnx.ModelProto, old: str, new: str) -> None:
    for value in (*model.graph.input, *model.graph.output):
        value.name = new if value.name == old else value.name
    for node in model.graph.node:
        for names in (node.input, node.output):
            names[:] = [new if name == old else name for name in names]


@by_provider
@pytest.mark.parametrize(
    ("graph", "old", "new", "message"),
    [
        ("backbone", "canvas", "image", "has an unknown input `image`, the runtime knows canvas"),
        ("encoder", "pillar_index", "pillar_of_point", "has an unknown input `pillar_of_point`"),
        ("backbone", "directions", "yaw_bins", "has no output `directions`, only .*yaw_bins"),
    ],
)
def test_inputs_and_outputs_of_other_names(
    bundle_copy: Path, provider: Provider, graph: str, old: str, new: str, message: str
) -> None:
    corrupt_graph(bundle_copy, f"{graph}.onnx", lambda model: rename(model, old, new))
    with pytest.raises(BundleError, match=rf"{graph}\.onnx {message}"):
        Detector(bundle_copy, provider=provider)


@by_provider
def test_outputs_are_found_by_name_not_by_order(
    bundle_copy: Path, tiny_bundle: Path, scan: NDArray[np.float32], provider: Provider
) -> None:
    def turn_round(model: onnx.ModelProto) -> None:
        outputs = list(model.graph.output)[::-1]
        del model.graph.output[:]
        model.graph.output.extend(outputs)

    corrupt_graph(bundle_copy, "backbone.onnx", turn_round)
    turned, straight = Detector(bundle_copy, provider=provider)(scan), Detector(tiny_bundle, provider=provider)(scan)
    assert len(straight) > 3
    assert (turned.boxes == straight.boxes).all()


@pytest.mark.parametrize(
    ("field", "value", "message"),
    [
        ("channels", 16, r"`(canvas|pillar_features)` is .*8.*needs .*16"),
        ("max_x", 17.36, r"backbone\.onnx: input `canvas` is .*25, 57.*needs .*25, 113"),
    ],
)
def test_graphs_of_another_model(bundle_copy: Path, field: str, value: float, message: str) -> None:
    good = load_pillar_bundle(bundle_copy)
    if field == "channels":
        other = replace(good, pillar=replace(good.pillar, channels=int(value)))
    else:
        other = replace(good, spec=replace(good.spec, grid=replace(good.spec.grid, x_range_m=(2.0, value))))
    sign(bundle_copy, other)
    with pytest.raises(BundleError, match=message) as caught:
        Detector(bundle_copy)
    assert "\n" not in str(caught.value)


@by_provider
def test_fewer_classes_than_the_head(bundle_copy: Path, provider: Provider) -> None:
    good = load_pillar_bundle(bundle_copy)
    sign(bundle_copy, replace(good, spec=replace(good.spec, classes=good.spec.classes[:1])))
    with pytest.raises(BundleError, match=r"output `scores` is .*\(1, 12, 28, 6\).*needs .*\(1, 12, 28, 2\)"):
        Detector(bundle_copy, provider=provider)


def test_opset_from_the_future(bundle_copy: Path) -> None:
    def raise_opset(model: onnx.ModelProto) -> None:
        model.opset_import[0].version = 999

    corrupt_graph(bundle_copy, "backbone.onnx", raise_opset)
    with pytest.raises(BundleError, match=r"cannot run .*backbone\.onnx: .*Opset 999.*upgrade") as caught:
        Detector(bundle_copy)
    assert "\n" not in str(caught.value)
