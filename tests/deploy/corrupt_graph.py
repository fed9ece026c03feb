"""Graphs whose output is spoiled."""

from collections.abc import Callable
from pathlib import Path

import onnx

from asca_deploy.manifest import load_pillar_bundle
from tests.deploy.conftest import sign


def corrupt_graph(bundle: Path, graph: str, spoil: Callable[[onnx.ModelProto], None]) -> Path:
    """Change a graph and sign it again, so that only its contents are wrong."""
    good = load_pillar_bundle(bundle)
    model = onnx.load(bundle / graph)
    spoil(model)
    onnx.save(model, bundle / graph)
    sign(bundle, good)
    return bundle
