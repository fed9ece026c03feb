import json
import math
import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import onnx
import pytest

from asca_deploy.bundle import MANIFEST, GraphFile, Parity
from asca_deploy.manifest import (
    bundle_to_json,
    difference,
    graph_files,
    layout_of,
    load_bundle,
    load_pillar_bundle,
    write_bundle_manifest,
)
from asca_pillars.base.errors import BundleError
from asca_pillars.ops.pillar.grid import PillarGrid
from asca_pillars.ops.pillar.prepare import FEATURES
from asca_pillars.ops.pillar.spec import PillarSpec
from tests.deploy.conftest import sign
from tests.deploy.edited_manifest import NOT_THE_GRAPHS, assert_refused, edit
from tests.helpers.bundles import DENSE_FLOAT32, DENSE_INT8, PV_RCNN


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


def test_layout_of_the_papers_grid(tiny_bundle: Path) -> None:
    bundle = replace(load_pillar_bundle(tiny_bundle), spec=PillarSpec())
    layout = bundle_to_json(bundle)["pillar"]["layout"]
    # 69.12 m in three zones of 23.04 m: 72 x 0.32, 144 x 0.16 and 288 x 0.08 (DESIGN 4.1).
    assert layout["x_zones"] == [
        {"start_m": 0.0, "pillar_m": 0.32, "pillars": 72},
        {"start_m": 23.04, "pillar_m": 0.16, "pillars": 144},
        {"start_m": 46.08, "pillar_m": 0.08, "pillars": 288},
    ]
    assert layout["y_zones"] == [{"start_m": -39.68, "pillar_m": 0.16, "pillars": 496}]
    assert layout["canvas_shape"] == [497, 505]
    assert layout["head_shape"] == [248, 252]
    assert layout["features"] == list(FEATURES)


def test_layout_of_a_uniform_grid_is_one_zone(tiny_bundle: Path) -> None:
    grid = PillarGrid(x_range_m=(3.0, 15.8), y_range_m=(-2.56, 1.28), v_max_m=0.16, zones=1)
    layout = bundle_to_json(replace(load_pillar_bundle(tiny_bundle), spec=PillarSpec(grid=grid)))["pillar"]["layout"]
    assert layout["x_zones"] == [{"start_m": 3.0, "pillar_m": 0.16, "pillars": 80}]


@pytest.mark.parametrize(
    ("change", "key"),
    [
        (lambda layout: layout["features"].reverse(), "features.0"),
        (lambda layout: layout["x_zones"][1].update(pillar_m=0.17), "x_zones.1.pillar_m"),
        (lambda layout: layout["x_zones"].pop(), "x_zones"),
        (lambda layout: layout.update(canvas_shape=[56, 24]), "canvas_shape.0"),
        (lambda layout: layout.pop("anchor_yaws_rad"), r"\*"),
        (lambda layout: layout.update(head_shape="12x28"), "head_shape"),
    ],
)
def test_a_layout_that_does_not_follow_from_the_spec(
    tiny_bundle: Path, change: Callable[[dict[str, Any]], object], key: str
) -> None:
    layout = layout_of(load_pillar_bundle(tiny_bundle).spec)
    written = json.loads(json.dumps(layout))
    assert difference(written, layout) is None
    change(written)
    found = difference(written, layout)
    assert found is not None and re.fullmatch(key, found)


def test_a_layout_within_rounding_is_accepted(tiny_bundle: Path) -> None:
    layout = layout_of(load_pillar_bundle(tiny_bundle).spec)
    written = json.loads(json.dumps(layout))
    written["x_zones"][0].update(start_m=2.0000000004)
    assert difference(written, layout) is None


def test_a_signed_layout_that_does_not_follow_from_the_spec(bundle_copy: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """As a version whose features meant something else would have written it."""
    bundle = load_pillar_bundle(bundle_copy)
    other = layout_of(bundle.spec) | {"features": ["z", "y", "x"]}
    with monkeypatch.context() as patched:
        patched.setattr("asca_deploy.manifest.layout_of", lambda spec: other)
        sign(bundle_copy, bundle)
    assert_refused(bundle_copy, r"`pillar\.layout\.features` is not what .* derives from `spec`; export")


@pytest.mark.parametrize("change", [lambda data: data["pillar"].pop("layout"), lambda data: data.update(pillar=[])])
def test_no_layout(bundle_copy: Path, change: Callable[[dict[str, Any]], object]) -> None:
    edit(bundle_copy, change)
    assert_refused(bundle_copy, "pillar")


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
        (lambda data: data["spec"]["grid"].update(zones=9), "zones 9 must lie between 1 and 5"),
        (lambda data: data["pillar"].update(channels="many"), r"`pillar\.channels` = 'many'"),
        (lambda data: data["pillar"].update(channels=True), r"`pillar\.channels` = true: input should be a number"),
        (lambda data: data["pillar"].update(channels="8"), r"`pillar\.channels` is missing or of the wrong type"),
        (lambda data: data["expected_input"].update(ground_z_m=[1.0, -1.0]), r"ground_z_m = .* lowest and highest"),
        (lambda data: data["spec"].pop("post"), r"`spec\.post` is missing"),
        (lambda data: data["graphs"].pop("encoder"), "graphs encoder and backbone, not backbone"),
        (lambda data: data["graphs"]["encoder"].update(sha256="0\x1b[31m"), r"sha256 .* is no SHA-256"),
        (lambda data: data["provenance"].update(weights_sha256="0" * 63), "sha256 .* of the weights is no SHA-256"),
        (lambda data: data["expected_input"].update(ground_z_m=[1.0]), r"expected_input\.ground_z_m"),
    ],
)
def test_wrong_keys_and_values(bundle_copy: Path, change: Callable[[dict[str, Any]], object], message: str) -> None:
    edit(bundle_copy, change)
    assert_refused(bundle_copy, f"{message}.*export the bundle again")


def test_provenance_need_not_say_which_weights(bundle_copy: Path) -> None:
    before = load_pillar_bundle(bundle_copy)
    edit(bundle_copy, lambda data: data["provenance"].pop("weights_sha256"))
    assert load_pillar_bundle(bundle_copy) == before


@pytest.mark.parametrize("graph", ["encoder.onnx", "backbone.onnx"])
def test_a_damaged_graph(bundle_copy: Path, graph: str) -> None:
    content = bytearray((bundle_copy / graph).read_bytes())
    content[len(content) // 2] ^= 1
    (bundle_copy / graph).write_bytes(content)
    assert_refused(bundle_copy, rf"{graph} is damaged or belongs to another bundle: its SHA-256")


def test_a_missing_graph(bundle_copy: Path) -> None:
    (bundle_copy / "backbone.onnx").unlink()
    assert_refused(bundle_copy, r"backbone\.onnx is missing")


@pytest.mark.parametrize(
    "name", ["../encoder.onnx", "/etc/passwd", "a/b.onnx", "..", "", "c:x.onnx", "..\\x", "x" * 100_000, "a\0"]
)
def test_graph_names_stay_inside_the_folder(bundle_copy: Path, name: str) -> None:
    edit(bundle_copy, lambda data: data["graphs"]["encoder"].update(file=name))
    assert_refused(bundle_copy, "is not a file name")


def test_a_manifest_is_not_written_for_graphs_that_are_not_there(bundle_copy: Path, tmp_path: Path) -> None:
    bundle = load_pillar_bundle(bundle_copy)
    swapped = replace(bundle, graphs={**bundle.graphs, "backbone": GraphFile("other.onnx", "0" * 64)})
    with pytest.raises(BundleError, match=r"other\.onnx is missing"):
        write_bundle_manifest(bundle_copy, swapped)
    assert load_pillar_bundle(bundle_copy) == bundle


def test_an_edit_of_what_boxes_depend_on_is_noticed(bundle_copy: Path) -> None:
    edit(bundle_copy, lambda data: data["spec"]["classes"][0].update(length_m=13.9))
    assert_refused(bundle_copy, NOT_THE_GRAPHS.format("spec"))


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
