import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from asca_deploy.bundle import (
    MANIFEST,
    SCHEMA_VERSION,
    GraphFile,
    Graphs,
    Parity,
    bundle_to_json,
    default_bundle_path,
    find_bundle,
    load_bundle,
    sample_scan_path,
    shipped_bundles,
    write_bundle_manifest,
)
from asca_pillars.errors import BundleError
from asca_pillars.pillars.grid import PillarGrid
from asca_pillars.pillars.pillar_spec import PillarSpec
from asca_pillars.pillars.pillarize import FEATURES


def edit(bundle: Path, change: Callable[[dict[str, Any]], object]) -> Path:
    """Change bundle.json by hand."""
    data = json.loads((bundle / MANIFEST).read_text())
    change(data)
    (bundle / MANIFEST).write_text(json.dumps(data))
    return bundle


def assert_refused(bundle: Path, message: str) -> None:
    with pytest.raises(BundleError, match=message) as caught:
        load_bundle(bundle)
    text = str(caught.value)
    assert "\n" not in text
    assert str(bundle) in text  # whose fault it is


def test_round_trip(bundle_copy: Path) -> None:
    bundle = load_bundle(bundle_copy)
    proven = replace(bundle, parity=Parity(2e-6, 1e-5, 1e-6, scans=8, tolerance=1e-3))
    write_bundle_manifest(bundle_copy, proven)
    assert load_bundle(str(bundle_copy)) == proven
    assert json.loads((bundle_copy / MANIFEST).read_text()) == bundle_to_json(proven)


def test_layout_of_the_papers_grid(tiny_bundle: Path) -> None:
    bundle = replace(load_bundle(tiny_bundle), spec=PillarSpec())
    layout = bundle_to_json(bundle)["layout"]
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
    layout = bundle_to_json(replace(load_bundle(tiny_bundle), spec=PillarSpec(grid)))["layout"]
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
    bundle_copy: Path, change: Callable[[dict[str, Any]], object], key: str
) -> None:
    edit(bundle_copy, lambda data: change(data["layout"]))
    assert_refused(bundle_copy, rf"`layout\.{key}` is not what .* derives from `spec`; export")


def test_a_layout_within_rounding_is_accepted(bundle_copy: Path) -> None:
    edit(bundle_copy, lambda data: data["layout"]["x_zones"][0].update(start_m=2.0000000004))
    load_bundle(bundle_copy)


def test_no_layout(bundle_copy: Path) -> None:
    edit(bundle_copy, lambda data: data.pop("layout"))
    assert_refused(bundle_copy, "layout")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda data: data.update(chanels=8), "unknown key `chanels`; did you mean `channels`"),
        (
            lambda data: data["spec"]["grid"].update(v_maxm=0.3),
            r"unknown key `spec\.grid\.v_maxm`; did you mean `v_max_m`",
        ),
        (lambda data: data["provenance"].update(sead=3), r"unknown key `provenance\.sead`"),
        (lambda data: data.pop("license"), "missing key `license`"),
        (lambda data: data["spec"]["grid"].update(zones=9), "zones 9 must lie between 1 and 5"),
        (lambda data: data.update(channels="many"), "`channels` = 'many'"),
        (lambda data: data["expected_input"].update(ground_z_m=[1.0]), r"expected_input\.ground_z_m"),
    ],
)
def test_wrong_keys_and_values(bundle_copy: Path, change: Callable[[dict[str, Any]], object], message: str) -> None:
    edit(bundle_copy, change)
    assert_refused(bundle_copy, f"{message}.*export the bundle again")


@pytest.mark.parametrize("version", [None, "1", 1.0, True, [1]])
def test_no_usable_schema_version(bundle_copy: Path, version: object) -> None:
    edit(bundle_copy, lambda data: data.update(schema_version=version))
    assert_refused(bundle_copy, "`schema_version` is .*export the bundle again")


def test_newer_schema_version_is_said_before_anything_else(bundle_copy: Path) -> None:
    edit(bundle_copy, lambda data: data.update(schema_version=SCHEMA_VERSION + 1, graphs="packed"))
    assert_refused(bundle_copy, r"schema_version 3 is newer .*pip install --upgrade asca-pillars")


def test_older_schema_version(bundle_copy: Path) -> None:
    edit(bundle_copy, lambda data: data.update(schema_version=1))
    assert_refused(bundle_copy, "schema_version 1 is no longer read; export the bundle again")


@pytest.mark.parametrize("text", ["", "{", "[1, 2]", '"bundle"', "null", "\xff"])
def test_a_manifest_that_is_no_manifest(bundle_copy: Path, text: str) -> None:
    (bundle_copy / MANIFEST).write_bytes(text.encode("latin-1"))
    assert_refused(bundle_copy, "is damaged|is not a bundle's manifest")


@pytest.mark.parametrize("graph", ["encoder.onnx", "backbone.onnx"])
def test_a_damaged_graph(bundle_copy: Path, graph: str) -> None:
    content = bytearray((bundle_copy / graph).read_bytes())
    content[len(content) // 2] ^= 1
    (bundle_copy / graph).write_bytes(content)
    assert_refused(bundle_copy, rf"{graph} is damaged or belongs to another bundle: its SHA-256")


def test_a_missing_graph(bundle_copy: Path) -> None:
    (bundle_copy / "backbone.onnx").unlink()
    assert_refused(bundle_copy, r"backbone\.onnx is missing")


@pytest.mark.parametrize("name", ["../encoder.onnx", "/etc/passwd", "a/b.onnx", "..", "", "c:x.onnx", "..\\x"])
def test_graph_names_stay_inside_the_folder(bundle_copy: Path, name: str) -> None:
    edit(bundle_copy, lambda data: data["graphs"]["encoder"].update(file=name))
    assert_refused(bundle_copy, "is not a file name")


def test_no_bundle_there(tmp_path: Path) -> None:
    assert_refused(tmp_path / "nowhere", "is no model bundle.*asca export")
    assert_refused(tmp_path, "is no model bundle")
    checkpoint = tmp_path / "last.ckpt"
    checkpoint.write_bytes(b"weights")
    assert_refused(checkpoint, "is no model bundle")


def test_a_bundle_is_found_by_folder_and_by_shipped_name(tiny_bundle: Path) -> None:
    assert find_bundle(tiny_bundle) == tiny_bundle
    assert find_bundle("asca_small_sim") == shipped_bundles()["asca_small_sim"]
    assert find_bundle(None) == default_bundle_path()
    with pytest.raises(
        BundleError, match=r"asca_smal: no such folder, and no bundle .* asca_small_sim, asca_small_sim_int8"
    ):
        find_bundle("asca_smal")


def test_a_manifest_is_not_written_for_graphs_that_are_not_there(bundle_copy: Path, tmp_path: Path) -> None:
    bundle = load_bundle(bundle_copy)
    swapped = replace(bundle, graphs=Graphs(bundle.graphs.encoder, GraphFile("other.onnx", "0" * 64)))
    with pytest.raises(BundleError, match=r"other\.onnx is missing"):
        write_bundle_manifest(bundle_copy, swapped)
    assert load_bundle(bundle_copy) == bundle


def test_shipped_files_lie_in_the_package() -> None:
    assert default_bundle_path().parts[-3:] == ("asca_deploy", "bundles", "asca_small_sim_int8")
    assert [(name, load_bundle(folder).name) for name, folder in shipped_bundles().items()] == [
        ("asca_small_sim", "asca_small_sim"),
        ("asca_small_sim_int8", "asca_small_sim_int8"),
    ]
    assert sample_scan_path().parts[-3:] == ("asca_deploy", "samples", "street.bin")
