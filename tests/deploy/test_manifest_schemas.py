"""Manifests without keys that came later, and every field of one: a change is refused, or without effect on boxes."""

import json
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import onnx

from asca_deploy.bundle import MANIFEST, PvRcnnBundle
from asca_deploy.manifest import graph_files, load_bundle, load_pillar_bundle
from asca_pillars.base.errors import BundleError
from asca_pillars.base.schema import to_dict
from tests.deploy.edited_manifest import NOT_THE_GRAPHS, assert_refused, edit
from tests.helpers.bundles import DENSE_INT8, PV_RCNN


def test_a_bundle_that_names_no_neck_has_a_dense_one(tmp_path: Path) -> None:
    folder = Path(shutil.copytree(DENSE_INT8, tmp_path / "int8"))
    assert "neck" not in json.loads((folder / MANIFEST).read_text())["pillar"]
    section = load_pillar_bundle(folder).pillar
    assert (section.neck, section.active_cells) == ("dense", None)
    edit(folder, lambda data: data["pillar"].update(neck="sparse", active_cells="fine"))
    assert_refused(folder, NOT_THE_GRAPHS.format("pillar"))


def test_refined_boxes_of_an_older_bundle_have_the_scores_that_they_had(tmp_path: Path) -> None:
    folder = Path(shutil.copytree(PV_RCNN, tmp_path / "older"))
    data = json.loads((folder / MANIFEST).read_text())
    assert data["pv_rcnn"].pop("scores") == "both"
    for graph in data["graphs"].values():
        model = onnx.load(folder / graph["file"])
        stamped = {prop.key: prop.value for prop in model.metadata_props}
        onnx.helper.set_model_props(model, stamped | {"pv_rcnn": json.dumps(data["pv_rcnn"])})
        onnx.save(model, folder / graph["file"])
    data["graphs"] = {name: to_dict(file) for name, file in graph_files(folder, data["graphs"]).items()}
    (folder / MANIFEST).write_text(json.dumps(data))
    bundle = load_bundle(folder)
    assert isinstance(bundle, PvRcnnBundle) and bundle.pv_rcnn.scores == "second"


HARMLESS = "parity", "quantization", "expected_input", "expected_input_from", "provenance", "backbone_gmac"
HOSTILE: tuple[Any, ...] = (
    *(None, True, False, -1, 0, 1, 3, 0.5, -1e308, 1e308, 2**63, 10**400),
    *("", "0", "x" * 100_000, "\x1b[31m\n", "int8"),
    *([], [None], {}, {"a": {}}, [[[]]]),
)


def leaves(value: Any, path: tuple[Any, ...] = ()) -> Iterator[tuple[Any, ...]]:
    """Paths of all values in a manifest, the containers too."""
    yield path
    items = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    for key, inner in items:
        yield from leaves(inner, (*path, key))


def test_every_field_is_refused_or_harmless(tmp_path: Path) -> None:
    """Each value of an int8 manifest replaced or taken out: one line, or the same boxes."""
    folder = Path(shutil.copytree(DENSE_INT8, tmp_path / "int8"))
    good, text = load_pillar_bundle(folder), (folder / MANIFEST).read_text()
    paths = [path for path in leaves(json.loads(text)) if path]
    assert len(paths) > 150
    rng = np.random.default_rng(0)
    refused = 0
    for path in paths:
        for mutation in rng.choice(len(HOSTILE) + 1, 3, replace=False):
            data = json.loads(text)
            parent = data
            for key in path[:-1]:
                parent = parent[key]
            if mutation == len(HOSTILE):
                del parent[path[-1]]
            else:
                parent[path[-1]] = HOSTILE[mutation]
            (folder / MANIFEST).write_text(json.dumps(data))
            try:
                found = load_pillar_bundle(folder)
            except BundleError as error:
                assert str(error).isprintable() and len(str(error)) < 1500 and str(folder) in str(error)
                refused += 1
                continue
            assert found.spec == good.spec and found.graphs == good.graphs, path
            assert (found.pillar, found.precision) == (good.pillar, good.precision), path
            same = data == json.loads(text) or path[0] in HARMLESS
            assert same, f"{path} = {parent[path[-1]]} was taken"
    assert refused > 300
