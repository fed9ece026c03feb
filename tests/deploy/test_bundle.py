from pathlib import Path

import pytest

from asca_deploy import shipped
from asca_deploy.bundle import CanvasFormat, PillarSection
from asca_deploy.manifest import load_bundle
from asca_deploy.shipped import default_bundle_path, find_bundle, find_weights, sample_scan_path, shipped_bundles
from asca_pillars.base import installation
from asca_pillars.base.errors import BundleError, ConfigError


def test_a_bundle_is_found_by_folder_and_by_shipped_name(tiny_bundle: Path) -> None:
    assert find_bundle(tiny_bundle) == tiny_bundle
    assert find_bundle("fast") == shipped_bundles()["fast"]
    assert find_bundle(None) == default_bundle_path()
    with pytest.raises(BundleError, match=r"fastt: no such folder, .* only accurate, .*, fast; make"):
        find_bundle("fastt")
    with pytest.raises(BundleError, match=r"only its weights ship; make a bundle with `asca export pvrcnn_small_sim"):
        find_bundle("pvrcnn_small_sim")


def test_names_of_earlier_versions_are_still_known() -> None:
    names = {"asca_sim_int8": "default", "asca_small_sparse_sim_int8": "fast", "asca_refine_sim_int8": "accurate"}
    for earlier, name in (names | {"asca_sim": "default_float32"}).items():
        assert find_bundle(earlier) == shipped_bundles()[name]


def test_weights_lie_in_some_bundles(tiny_bundle: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with_weights = tmp_path / "with_weights"
    with_weights.mkdir()
    (with_weights / "weights.ckpt").touch()
    ships = {"plain": tiny_bundle}
    for module in (shipped, installation):
        monkeypatch.setattr(module, "shipped_models", lambda: ships)
    with pytest.raises(BundleError, match=r"plain: holds no weights\.ckpt, .*--with-weights.* ship none has one"):
        shipped.find_weights("plain")
    (tmp_path / "run" / "checkpoints").mkdir(parents=True)
    (tmp_path / "run" / "checkpoints" / "last.ckpt").touch()
    for read in (shipped.find_weights, load_bundle):
        with pytest.raises(BundleError, match=r"training run, no model bundle; give its checkpoint, .*last\.ckpt"):
            read(tmp_path / "run")
    ships["heavy"] = with_weights
    with pytest.raises(BundleError, match=r"tiny: holds no weights\.ckpt, .* of those that ship heavy has one"):
        shipped.find_weights(tiny_bundle)
    assert shipped.find_weights("heavy") == shipped.find_weights(with_weights) == with_weights / "weights.ckpt"
    ships[f"{tiny_bundle.name}_float32"] = with_weights
    assert shipped.find_weights("plain") == with_weights / "weights.ckpt"


def test_shipped_files_lie_in_the_package() -> None:
    assert default_bundle_path().parts[-3:] == ("asca_deploy", "bundles", "default")
    assert [load_bundle(folder).name for folder in shipped_bundles().values()] == [*shipped_bundles()]
    assert [*shipped_bundles()] == ["accurate", "default", "default_float32", "fast"]
    assert find_weights("default") == find_weights("default_float32")
    assert find_weights("pvrcnn_small_sim").is_file()
    assert sample_scan_path().parts[-3:] == ("asca_deploy", "samples", "street.bin")


@pytest.mark.parametrize(
    ("channels", "kind", "empty"),
    [(3, "uint8", (1, 2)), (3, "uint8", ()), (1, "uint8", (256,)), (1, "uint8", (-1,)), (0, "float32", ())],
)
def test_a_canvas_needs_a_value_of_its_type_for_each_channel(channels: int, kind: str, empty: tuple[int, ...]) -> None:
    with pytest.raises(ConfigError, match=r"canvas\.empty|channels"):
        PillarSection("none", channels, CanvasFormat(kind, empty))  # type: ignore[arg-type]
