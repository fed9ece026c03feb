"""A static page that runs a bundle in the browser: our modules, the bundle, a scan, and ONNX Runtime's WebAssembly.

The page is a flat folder, with a zip of it beside, and needs no network and no program on the server. ONNX Runtime
comes from npm's package onnxruntime-web, which is read where `npm pack` or `npm install` put it and never fetched from
here.
"""

import importlib.util
import json
import tarfile
import zipfile
import zlib
from collections.abc import Callable
from importlib import resources
from pathlib import Path

from asca_deploy.bundle import MANIFEST
from asca_deploy.manifest import load_pillar_bundle, read_manifest
from asca_pillars.base.errors import BundleError, ConfigError
from asca_pillars.base.files import atomic_directory, atomic_path, require_content, write_json
from asca_pillars.base.own_files import json_object, require_not_input, require_own_file, require_replaceable
from asca_pillars.pictures.colors import color_table, height_table
from asca_pillars.scans.scan_reader import read_scan, write_scan

PAGE = "page.json"
_COMMAND = "asca export --browser"
_KEYS = ("bundle", "scan", "onnxruntime_web", "files")
PAGE_FOLDER = (_COMMAND, PAGE, json_object(*_KEYS))
"""Command, marker and its recognizer, as `atomic_directory` takes them."""
SAMPLE = "sample.bin"
START = "Open it from a file server: python -m http.server --directory {out}"
ORT_FILES = ("ort.wasm.bundle.min.mjs", "ort-wasm-simd-threaded.wasm")
"""Of the package's `dist`: ONNX Runtime for the CPU alone, 14 MB."""
ORT_LICENSE = "LICENSE-onnxruntime.txt"
"""License of ONNX Runtime, which its package does not hold; it lies among our modules."""
ORT_NOTICES = "ThirdPartyNotices-onnxruntime.txt"
"""Licenses of what is built into ONNX Runtime, from the installed one."""
ORT_VERSION = "1.30.0"
"""What the tests run."""

_LARGEST_PAGE_BYTES = 1 << 20
_GET_IT = f"get it with `npm pack onnxruntime-web@{ORT_VERSION}` and give the .tgz with --ort-web"


def write_page(out: Path, bundle: Path, scan: Path, ort_web: Path) -> int:
    """Write the page for one bundle, and beside it a zip of it (`page_zip`); the size of the folder in bytes.

    Args:
        out: folder: absent, empty, or an earlier output of this function, as the zip has to be.
        bundle: folder of a bundle of kind pillar on a warped map.
        scan: what the page shows first; any format that `read_scan` reads.
        ort_web: npm's package onnxruntime-web, a .tgz or its folder.

    Raises:
        BundleError: the bundle is damaged, or of a kind that the page does not run.
        ConfigError: the package is not one.
        OutputError: `out` or the zip is something else, or what is read.
    """
    require_replaceable(out, *PAGE_FOLDER)
    require_not_input(out, (bundle, scan, ort_web))
    archive = page_zip(out)
    require_own_file(archive, _COMMAND, _is_own_zip, (bundle, scan, ort_web))
    manifest = load_pillar_bundle(bundle)
    if manifest.kind != "pillar" or manifest.spec.grid.pools:
        raise BundleError(
            f"{bundle}: kind {manifest.kind}, {manifest.spec.grid.map} map; the page runs kind pillar on a warped map"
        )
    if manifest.spec.anchor_places != "cells" or manifest.spec.anchor_scores != "own":
        raise BundleError(
            f"{bundle}: anchor_places {manifest.spec.anchor_places}, anchor_scores {manifest.spec.anchor_scores}; the "
            "page runs anchors at cell centers with one score for each (anchor_places cells, anchor_scores own)"
        )
    version, read = _open_package(ort_web)
    points = read_scan(scan).points
    with atomic_directory(out, *PAGE_FOLDER) as folder:
        for file in page_modules():
            (folder / file.name).write_bytes(file.read_bytes())
        # Under names of ours, whatever the bundle calls its graphs: they lie beside the page's scripts.
        described = read_manifest(bundle / MANIFEST)
        for name, graph in manifest.graphs.items():
            described["graphs"][name]["file"] = f"{name}.onnx"
            (folder / f"{name}.onnx").write_bytes((bundle / graph.file).read_bytes())
        write_json(folder / MANIFEST, described)
        for name in ORT_FILES:
            (folder / name).write_bytes(read(f"dist/{name}"))
        if (notices := _installed_notices()) is not None:
            (folder / ORT_NOTICES).write_bytes(notices.read_bytes())
        write_scan(folder / SAMPLE, points)
        files = sorted(path.name for path in folder.iterdir())
        content = {
            "bundle": manifest.name,
            "scan": scan.name,
            "onnxruntime_web": version,
            "colors": color_table(class_spec.name for class_spec in manifest.spec.classes),
            "heights": height_table(),
            "files": files,
        }
        write_json(folder / PAGE, content)
    with atomic_path(archive) as temporary:
        _write_zip(temporary, out)
    return sum(path.stat().st_size for path in out.iterdir())


def page_zip(out: Path) -> Path:
    """Path of the zip of the page in the folder `out`: beside it."""
    folder = out.resolve()  # `.` has no name
    return folder.with_name(f"{folder.name}.zip")


def find_ort_web(given: Path | None) -> Path:
    """The package that was given, or what `npm pack` or `npm install` left in the working directory.

    Raises:
        ConfigError: there is none; says how to get it.
    """
    local = [Path("node_modules/onnxruntime-web"), *sorted(Path().glob("onnxruntime-web-*.tgz"))]
    for path in [given] if given else local:
        if path.exists():
            return path
    where = f"{given}: no such file or folder" if given else "npm's package onnxruntime-web is not in this folder"
    raise ConfigError(f"{where}; {_GET_IT}")


def _write_zip(path: Path, page: Path) -> None:
    """The folder of a page as a zip, the same bytes whenever it is written; `page.json` is its first file."""
    name = page_zip(page).stem
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for file in (page / PAGE, *sorted(path for path in page.iterdir() if path.name != PAGE)):
            about = zipfile.ZipInfo(f"{name}/{file.name}")
            about.external_attr = 0o644 << 16
            archive.writestr(about, file.read_bytes(), zipfile.ZIP_DEFLATED)


def _is_own_zip(path: Path) -> bool:
    """Return whether it is a zip of a page: the first of its files is one's `page.json`."""
    try:
        with zipfile.ZipFile(path) as archive:
            first = archive.infolist()[0]
            if not first.filename.endswith(f"/{PAGE}") or first.file_size > _LARGEST_PAGE_BYTES:
                return False
            content = json.loads(archive.read(first))
    # zipfile raises NotImplementedError for compressions and RuntimeError for passwords that it does not know.
    except (zipfile.BadZipFile, zlib.error, IndexError, ValueError, NotImplementedError, RuntimeError, EOFError):
        return False
    return isinstance(content, dict) and all(key in content for key in _KEYS)


def _installed_notices() -> Path | None:
    """The third-party notices of the installed onnxruntime, which is not imported; None if it has none."""
    spec = importlib.util.find_spec("onnxruntime")
    notices = None if spec is None or spec.origin is None else Path(spec.origin).with_name("ThirdPartyNotices.txt")
    return notices if notices is not None and notices.is_file() else None


def page_modules() -> list[Path]:
    """The files of the page that are ours, whatever it shows."""
    folder = Path(str(resources.files("asca_deploy") / "browser"))
    return sorted(path for path in folder.iterdir() if path.suffix in (".html", ".css", ".js", ".json", ".txt"))


def _open_package(path: Path) -> tuple[str, Callable[[str], bytes]]:
    """Version of the package, and what reads one of its files."""
    try:
        require_content(path, ConfigError)
        if path.is_dir():
            files = {name: (path / name).read_bytes() for name in ("package.json", *(f"dist/{n}" for n in ORT_FILES))}
        else:
            files = _unpacked(path)
        package = json.loads(files["package.json"])
        if package["name"] != "onnxruntime-web":
            raise ConfigError(f"{path}: npm's package {package['name']}; {_GET_IT}")
        return str(package["version"]), files.__getitem__
    except (OSError, KeyError, ValueError, tarfile.TarError) as error:
        raise ConfigError(f"{path}: is not npm's package onnxruntime-web ({error}); {_GET_IT}") from None


def _unpacked(path: Path) -> dict[str, bytes]:
    needed = {f"package/{name}" for name in ("package.json", *(f"dist/{n}" for n in ORT_FILES))}
    files = {}
    with tarfile.open(path) as archive:
        for member in archive:
            if member.name in needed and (stream := archive.extractfile(member)) is not None:
                files[member.name.removeprefix("package/")] = stream.read()
    if missing := needed - {f"package/{name}" for name in files}:
        raise KeyError(min(missing))
    return files
