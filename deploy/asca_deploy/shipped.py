"""Bundles and the scan that come with the package, by name; lookup of a bundle that a user names."""

import hashlib
from importlib import resources
from pathlib import Path
from typing import Any

from asca_deploy.bundle import MANIFEST, Bundle, weights_digest
from asca_deploy.manifest import load_bundle, refuse_run_folder
from asca_pillars.base.errors import BundleError
from asca_pillars.base.files import WEIGHTS_FILE, require_content
from asca_pillars.base.installation import find_shipped, shipped_models


def default_bundle_path() -> Path:
    """Return the folder of the default model: in 8 bits, which are faster than float32 on every CPU."""
    return shipped_bundles()["default"]


def shipped_bundles() -> dict[str, Path]:
    """Return the folders of the models that come with the package, by name."""
    return {name: folder for name, folder in shipped_models().items() if (folder / MANIFEST).is_file()}


def find_bundle(bundle: str | Path | None) -> Path:
    """Return the folder for a path, for the name of a bundle that ships, or for None.

    Raises:
        BundleError: there is neither.
    """
    if bundle is None:
        return default_bundle_path()
    if Path(bundle).exists():
        return Path(bundle)
    folder = find_shipped(str(bundle))
    if folder is None:
        raise BundleError(
            f"{bundle}: no such folder, and no bundle of that name ships, only {', '.join(shipped_bundles())};"
            " make one with `asca export`"
        )
    if not (folder / MANIFEST).is_file():
        raise BundleError(
            f"{bundle}: of this model only its weights ship; make a bundle with `asca export {bundle} -o {bundle}`"
        )
    return folder


def find_weights(bundle: str | Path) -> Path:
    """Return the checkpoint that a bundle (folder, or name of one that ships) holds beside its graphs.

    Those of a model that ships in 8 bits lie beside its float32 form: `default` has those of `default_float32`.

    Raises:
        BundleError: there is no such bundle, it is damaged, it holds none, or another one than it was exported with.
    """
    shipped = None if Path(bundle).exists() else find_shipped(str(bundle))
    if shipped is not None and not (shipped / WEIGHTS_FILE).is_file():
        shipped = find_shipped(f"{shipped.name}_float32") or shipped
    folder = shipped or find_bundle(bundle)
    path = folder / WEIGHTS_FILE
    require_content(path, BundleError)
    if not path.is_file():
        refuse_run_folder(folder)
        having = [name for name, folder in shipped_models().items() if (folder / WEIGHTS_FILE).is_file()]
        raise BundleError(
            f"{bundle}: holds no {WEIGHTS_FILE}, which `asca export --with-weights` adds to a bundle; of those that "
            f"ship {', '.join(having) or 'none'} has one"
        )
    known = (folder / MANIFEST).is_file()  # weights alone in a folder are weights, too
    expected = load_bundle(folder).provenance.weights_file_sha256 if known else None
    if expected is not None and hashlib.sha256(path.read_bytes()).hexdigest() != expected:
        raise BundleError(f"{path}: is damaged, or of another bundle; copy the whole bundle again")
    return path


def find_checkpoint(source: str | Path) -> Path:
    """Return a checkpoint itself, by its suffix, or the one that a bundle (folder, or name of one that ships) holds.

    Raises:
        BundleError: as `find_weights`.
    """
    path = Path(source)
    return path if path.is_file() or path.suffix == Path(WEIGHTS_FILE).suffix else find_weights(source)


def bundle_of_checkpoint(source: str | Path) -> Bundle | None:
    """Return the bundle that `source` names, whose checkpoint `find_checkpoint` gives; None for a checkpoint itself.

    Raises:
        BundleError: as `find_weights`, or it is damaged.
    """
    path = find_checkpoint(source)
    # The folder of a run's checkpoints holds weights, too, but no manifest.
    return load_bundle(path.parent) if path != Path(source) and (path.parent / MANIFEST).exists() else None


def sample_scan_path() -> Path:
    """Return the simulated scan that comes with the package, KITTI .bin."""
    return Path(str(resources.files("asca_deploy") / "samples" / "street.bin"))


def about_bundle(folder: Path) -> dict[str, Any]:
    """Describe a bundle as plain values; its graphs are compared with their digests.

    Raises:
        BundleError: it is missing, damaged or made for another version.
    """
    bundle = load_bundle(folder)
    provenance = bundle.provenance
    return {
        "name": bundle.name,
        "folder": str(folder),
        "kind": bundle.kind,
        "precision": bundle.precision,
        "classes": list(bundle.spec.class_names),
        "weights_sha256": weights_digest(bundle),
        "schema_version": bundle.schema_version,
        "created": provenance.created,
        "trained_on": provenance.trained_on,
        "license": bundle.license,
        "size_bytes": sum(path.stat().st_size for path in folder.iterdir() if path.is_file()),
    }
