"""Manifests: what is written and read, and that a change of any field is refused, or without effect on boxes.

What is read of an ONNX file without the package onnx, against that package.
"""

import json
import math
import shutil
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from onnx import TensorProto, helper, numpy_helper

from asca_deploy.bundle import MANIFEST, SCHEMA_VERSION, GraphFile, Parity, PvRcnnBundle
from asca_deploy.manifest import (
    bundle_to_json,
    difference,
    graph_files,
    has_external_data,
    layout_of,
    load_bundle,
    load_pillar_bundle,
    read_metadata,
    write_bundle_manifest,
)
from asca_pillars.base.errors import BundleError
from asca_pillars.base.schema import to_dict
from asca_pillars.ops.pillar.grid import PillarGrid
from asca_pillars.ops.pillar.prepare import FEATURES
from asca_pillars.ops.pillar.spec import PillarSpec
from tests.deploy.conftest import sign
from tests.helpers.bundles import DENSE_FLOAT32, DENSE_INT8, PV_RCNN

NOT_THE_GRAPHS = r"`{}` is not the one that \w+\.onnx was exported with; .*export"


def edit(bundle: Path, change: Callable[[dict[str, Any]], object]) -> Path:
    """Change bundle.json by hand."""
    data = json.loads((bundle / MANIFEST).read_text())
    change(data)
    (bundle / MANIFEST).write_text(json.dumps(data))
    return bundle


def assert_refused(bundle: Path, message: str) -> None:
    with pytest.raises(BundleError, match=message) as caught:
        load_pillar_bundle(bundle)
    text = str(caught.value)
    assert text.isprintable() and len(text) < 1500
    assert str(bundle) in text  # whose fault it is


def test_round_trip(bundle_copy: Path) -> None:
    bundle = load_pillar_bundle(bundle_copy)
    proven = replace(bundle, parity=Parity(2e-6, 1e-5, 1e-6, scans=8, tolerance=1e-3))
    write_bundle_manifest(bundle_copy, proven)
    assert load_pillar_bundle(str(bundle_copy)) == proven
    assert json.loads((bundle_copy / MANIFEST).read_text()) == bundle_to_json(proven)


def test_direction_bins_begin_at_45_degrees_where_the_manifest_does_not_say(bundle_copy: Path) -> None:
    for path in (DENSE_FLOAT32, DENSE_INT8, PV_RCNN):  # older than the key
        spec = json.loads((path / MANIFEST).read_text())["spec"]
        assert "direction_offset_rad" not in spec and load_bundle(path).spec.direction_offset_rad == math.pi / 4
    turned = replace(load_pillar_bundle(bundle_copy).spec, direction_offset_rad=-math.pi / 2)
    sign(bundle_copy, replace(load_pillar_bundle(bundle_copy), spec=turned))
    assert load_pillar_bundle(bundle_copy).spec == turned
    edit(bundle_copy, lambda data: data["spec"].pop("direction_offset_rad"))
    assert_refused(bundle_copy, NOT_THE_GRAPHS.format("spec"))


def test_the_layout_lists_zones_and_shapes(tiny_bundle: Path) -> None:
    bundle = load_pillar_bundle(tiny_bundle)
    layout = bundle_to_json(replace(bundle, spec=PillarSpec()))["pillar"]["layout"]
    # 69.12 m in three zones of 23.04 m: 72 x 0.32, 144 x 0.16 and 288 x 0.08 (DESIGN 4.1).
    assert layout["x_zones"] == [
        {"start_m": 0.0, "pillar_m": 0.32, "pillars": 72},
        {"start_m": 23.04, "pillar_m": 0.16, "pillars": 144},
        {"start_m": 46.08, "pillar_m": 0.08, "pillars": 288},
    ]
    assert layout["y_zones"] == [{"start_m": -39.68, "pillar_m": 0.16, "pillars": 496}]
    assert (layout["canvas_shape"], layout["head_shape"]) == ([497, 505], [248, 252])
    assert layout["features"] == list(FEATURES)
    uniform = PillarGrid(x_range_m=(3.0, 15.8), y_range_m=(-2.56, 1.28), v_max_m=0.16, zones=1)
    layout = bundle_to_json(replace(bundle, spec=PillarSpec(grid=uniform)))["pillar"]["layout"]
    assert layout["x_zones"] == [{"start_m": 3.0, "pillar_m": 0.16, "pillars": 80}]


@pytest.mark.parametrize(
    ("change", "key"),
    [
        (lambda layout: layout["features"].reverse(), "features.0"),
        (lambda layout: layout["x_zones"][1].update(pillar_m=0.17), "x_zones.1.pillar_m"),
        (lambda layout: layout["x_zones"].pop(), "x_zones"),
        (lambda layout: layout.update(canvas_shape=[56, 24]), "canvas_shape.0"),
        (lambda layout: layout.pop("anchor_yaws_rad"), "*"),
        (lambda layout: layout.update(head_shape="12x28"), "head_shape"),
        (lambda layout: layout["x_zones"][0].update(start_m=2.0000000004), None),  # within rounding
    ],
)
def test_a_layout_that_does_not_follow_from_the_spec(
    tiny_bundle: Path, change: Callable[[dict[str, Any]], object], key: str | None
) -> None:
    layout = layout_of(load_pillar_bundle(tiny_bundle).spec)
    written = json.loads(json.dumps(layout))
    assert difference(written, layout) is None
    change(written)
    assert difference(written, layout) == key


def test_a_signed_layout_that_does_not_follow_from_the_spec(bundle_copy: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """As a version whose features meant something else would have written it."""
    bundle = load_pillar_bundle(bundle_copy)
    other = layout_of(bundle.spec) | {"features": ["z", "y", "x"]}
    with monkeypatch.context() as patched:
        patched.setattr("asca_deploy.manifest.layout_of", lambda spec: other)
        sign(bundle_copy, bundle)
    assert_refused(bundle_copy, r"`pillar\.layout\.features` is not what .* derives from `spec`; export")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda data: data["pillar"].update(chanels=8), r"unknown key `pillar\.chanels`; did you mean `channels`"),
        (
            lambda data: data["spec"]["grid"].update(v_maxm=0.3),
            r"unknown key `spec\.grid\.v_maxm`; did you mean `v_max_m`",
        ),
        (lambda data: data["provenance"].update(sead=3), r"unknown key `provenance\.sead`"),
        (lambda data: data.pop("license"), "missing key `license`"),
        (lambda data: data.update(schema_version=1.0), "`schema_version` is"),
        (lambda data: data.update(schema_version=True), "`schema_version` is"),
        (lambda data: data.update(schema_version=1), "schema_version 1 is no longer read"),
        (lambda data: data["spec"]["grid"].update(zones=9), "zones 9 must lie between 1 and 5"),
        (lambda data: data["pillar"].update(channels=True), r"`pillar\.channels` = true: input should be a number"),
        (lambda data: data["expected_input"].update(ground_z_m=[1.0, -1.0]), r"ground_z_m = .* lowest and highest"),
        (lambda data: data["spec"].pop("post"), r"`spec\.post` is missing"),
        (lambda data: data["graphs"].pop("encoder"), "graphs encoder and backbone, not backbone"),
        (lambda data: data["graphs"]["encoder"].update(sha256="0\x1b[31m"), r"sha256 .* is not a SHA-256"),
        (lambda data: data["provenance"].update(weights_sha256="0" * 63), "sha256 .* of the weights is not a SHA-256"),
    ],
)
def test_wrong_keys_and_values(bundle_copy: Path, change: Callable[[dict[str, Any]], object], message: str) -> None:
    edit(bundle_copy, change)
    assert_refused(bundle_copy, f"{message}.*export the bundle again")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda data: data["pillar"].pop("layout"), "pillar"),
        (lambda data: data.update(pillar=[]), "pillar"),
        (lambda data: data["spec"]["classes"][0].update(length_m=13.9), NOT_THE_GRAPHS.format("spec")),
        # Before anything else is said.
        (lambda data: data.update(schema_version=SCHEMA_VERSION + 1, graphs="packed"), "4 is newer .*; upgrade with"),
    ],
)
def test_what_does_not_belong_together(
    bundle_copy: Path, change: Callable[[dict[str, Any]], object], message: str
) -> None:
    edit(bundle_copy, change)
    assert_refused(bundle_copy, message)


@pytest.mark.parametrize("text", ["", "{", "[1, 2]", '"bundle"', "null", "\xff"])
def test_a_manifest_that_is_no_manifest(bundle_copy: Path, text: str) -> None:
    (bundle_copy / MANIFEST).write_bytes(text.encode("latin-1"))
    assert_refused(bundle_copy, "is damaged|is not a bundle's manifest")


def test_duplicate_keys_and_deep_nesting(bundle_copy: Path) -> None:
    text = (bundle_copy / MANIFEST).read_text()
    (bundle_copy / MANIFEST).write_text(text.replace('"name": "tiny"', '"name": "tiny", "name": "tiny"', 1))
    assert_refused(bundle_copy, "key `name` is there twice")
    for damaged in ("[" * 200_000, '{"a":' * 50_000, text.replace("0.1", "NaN", 1), text + " " * 2_000_000):
        (bundle_copy / MANIFEST).write_text(damaged)
        assert_refused(bundle_copy, "is damaged|is larger than a manifest")


def test_no_bundle_there(tmp_path: Path) -> None:
    (tmp_path / "last.ckpt").write_bytes(b"weights")
    for path in (tmp_path / "nowhere", tmp_path, tmp_path / "last.ckpt"):
        assert_refused(path, "is not a model bundle")


def test_provenance_need_not_say_which_weights(bundle_copy: Path) -> None:
    before = load_pillar_bundle(bundle_copy)
    edit(bundle_copy, lambda data: data["provenance"].pop("weights_sha256"))
    assert load_pillar_bundle(bundle_copy) == before


@pytest.mark.parametrize("graph", ["encoder.onnx", "backbone.onnx"])
def test_a_damaged_or_missing_graph(bundle_copy: Path, graph: str) -> None:
    content = bytearray((bundle_copy / graph).read_bytes())
    content[len(content) // 2] ^= 1
    (bundle_copy / graph).write_bytes(content)
    assert_refused(bundle_copy, rf"{graph} is damaged or belongs to another bundle: its SHA-256")
    (bundle_copy / graph).unlink()
    assert_refused(bundle_copy, f"{graph} is missing")


@pytest.mark.parametrize("name", ["../encoder.onnx", "/etc/passwd", "..", "", "c:x.onnx", "..\\x", "x" * 9999, "a\0"])
def test_graph_names_stay_inside_the_folder(bundle_copy: Path, name: str) -> None:
    edit(bundle_copy, lambda data: data["graphs"]["encoder"].update(file=name))
    assert_refused(bundle_copy, "is not a file name")


def test_a_manifest_is_not_written_for_graphs_that_are_not_there(bundle_copy: Path, tmp_path: Path) -> None:
    bundle = load_pillar_bundle(bundle_copy)
    swapped = replace(bundle, graphs={**bundle.graphs, "backbone": GraphFile("other.onnx", "0" * 64)})
    with pytest.raises(BundleError, match=r"other\.onnx is missing"):
        write_bundle_manifest(bundle_copy, swapped)
    assert load_pillar_bundle(bundle_copy) == bundle


def test_graphs_without_a_stamp(bundle_copy: Path) -> None:
    bundle = load_pillar_bundle(bundle_copy)
    model = onnx.load(bundle_copy / "encoder.onnx")
    del model.metadata_props[:]
    onnx.save(model, bundle_copy / "encoder.onnx")
    with pytest.raises(BundleError, match=r"not the one that encoder\.onnx was exported with"):
        write_bundle_manifest(bundle_copy, replace(bundle, graphs=graph_files(bundle_copy)))


def test_graphs_with_external_data(bundle_copy: Path) -> None:
    bundle = load_pillar_bundle(bundle_copy)
    model = onnx.load(bundle_copy / "backbone.onnx")
    onnx.save(model, bundle_copy / "backbone.onnx", save_as_external_data=True, location="w.bin", size_threshold=0)
    data = json.loads((bundle_copy / MANIFEST).read_text())
    data["graphs"]["backbone"]["sha256"] = graph_files(bundle_copy)["backbone"].sha256
    (bundle_copy / MANIFEST).write_text(json.dumps(data))
    assert_refused(bundle_copy, r"backbone\.onnx keeps weights in another file")
    assert bundle.graphs  # it was a good one


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


def with_tensors(*tensors: onnx.TensorProto, within: onnx.TensorProto | None = None) -> onnx.ModelProto:
    """A model with these weights, and one more in a branch of an If."""
    branch = [helper.make_node("Constant", [], ["out"], value=within)] if within else []
    out = helper.make_tensor_value_info("out", TensorProto.FLOAT, [2])
    inner = helper.make_graph(branch, "branch", [], [out])
    choose = helper.make_node("If", ["yes"], ["out"], then_branch=inner, else_branch=inner)
    return helper.make_model(helper.make_graph([choose], "tiny", [], [out], list(tensors)))


def outside(tensor: onnx.TensorProto) -> onnx.TensorProto:
    """The tensor with its data in another file."""
    onnx.external_data_helper.set_external_data(tensor, "w.bin")
    tensor.ClearField("raw_data")
    tensor.data_location = TensorProto.EXTERNAL
    return tensor


def weight(name: str = "w") -> onnx.TensorProto:
    return numpy_helper.from_array(np.ones(2, np.float32), name)


@settings(max_examples=30)
@given(st.dictionaries(st.text(max_size=9), st.text(max_size=300), max_size=5))
def test_metadata(properties: dict[str, str]) -> None:
    model = with_tensors(weight())
    helper.set_model_props(model, properties)
    assert read_metadata(model.SerializeToString()) == properties


def test_external_data_wherever_it_is() -> None:
    assert not has_external_data(with_tensors(weight(), weight("v"), within=weight("u")).SerializeToString())
    assert has_external_data(with_tensors(weight(), outside(weight("v"))).SerializeToString())
    assert has_external_data(with_tensors(weight(), within=outside(weight("u"))).SerializeToString())


@given(st.binary(max_size=200))
def test_other_bytes_are_refused_or_read(data: bytes) -> None:
    for read in (read_metadata, has_external_data):
        try:
            read(data)
        except ValueError:
            continue


@pytest.mark.parametrize("name", ["encoder.onnx", "backbone.onnx"])
def test_a_file_that_ends_early(tiny_bundle: Path, name: str) -> None:
    content = (tiny_bundle / name).read_bytes()
    for end in range(1, len(content), 37):
        try:
            read_metadata(content[:end])
        except ValueError:
            continue
