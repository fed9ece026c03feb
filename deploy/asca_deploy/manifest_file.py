"""bundle.json as a file: reading its JSON, and checking that every value was taken as written."""

import json
import reprlib
from pathlib import Path
from typing import Any

from asca_deploy.bundle import MANIFEST, SCHEMA_VERSION
from asca_pillars.base.errors import BundleError, printable
from asca_pillars.base.input_files import require_content
from asca_pillars.base.installation import upgrade_advice

EXPORT_AGAIN = "export the bundle again with `asca export`"
LONGEST_REASON = 300
"""Characters of a damaged file's own words in a message."""

_LARGEST_BYTES = 1 << 20


def read_manifest(manifest: Path) -> dict[str, Any]:
    """Read the keys and values of a bundle.json of a supported schema; BundleError if it is none."""
    try:
        require_content(manifest, BundleError)
        if manifest.stat().st_size > _LARGEST_BYTES:
            raise BundleError(f"{manifest} is larger than a manifest ever is (1 MiB); {EXPORT_AGAIN}")
        text = manifest.read_text(encoding="utf-8-sig")
        data = json.loads(text, object_pairs_hook=_without_duplicates, parse_constant=_no_number)
    except (FileNotFoundError, NotADirectoryError):
        refuse_run_folder(manifest.parent)
        raise BundleError(
            f"{manifest.parent} is not a model bundle, it holds no {MANIFEST}; make one with `asca export`"
        ) from None
    except OSError as error:
        raise BundleError(f"{manifest}: {error.strerror}") from None
    except RecursionError:
        raise BundleError(f"{manifest} is damaged (nested too deeply); {EXPORT_AGAIN}") from None
    except ValueError as error:  # invalid JSON or UTF-8
        raise BundleError(f"{manifest} is damaged ({printable(str(error), LONGEST_REASON)}); {EXPORT_AGAIN}") from None
    version = data.get("schema_version") if isinstance(data, dict) else None
    if type(version) is not int:
        version_text = reprlib.repr(version)
        raise BundleError(f"{manifest} is not a bundle's manifest: `schema_version` is {version_text}; {EXPORT_AGAIN}")
    if version > SCHEMA_VERSION:
        raise BundleError(
            f"{manifest}: schema_version {reprlib.repr(version)} is newer than {SCHEMA_VERSION}, which this version "
            f"reads; {upgrade_advice()}"
        )
    if version < SCHEMA_VERSION:
        raise BundleError(f"{manifest}: schema_version {reprlib.repr(version)} is no longer read; {EXPORT_AGAIN}")
    return dict(data)


def first_parsing_difference(written: Any, understood: Any) -> str | None:
    """Return the path of the first value that was not taken as it is written, such as true for 1 or a default; or None.

    A key that is understood as None need not be written: bundles made before there was such a key lack it.
    """
    if isinstance(understood, dict):
        if not isinstance(written, dict):
            return "*"
        for key, value in understood.items():
            if key not in written and value is None:
                continue
            if key not in written:
                return str(key)
            if inner := first_parsing_difference(written[key], value):
                return key if inner == "*" else f"{key}.{inner}"
        return None
    if isinstance(understood, list):
        if not isinstance(written, list) or len(written) != len(understood):
            return "*"
        for index, (ours, theirs) in enumerate(zip(written, understood, strict=True)):
            if inner := first_parsing_difference(ours, theirs):
                return str(index) if inner == "*" else f"{index}.{inner}"
        return None
    if isinstance(understood, float) and type(written) is int:
        return None if written == understood else "*"
    return None if type(written) is type(understood) and written == understood else "*"


def refuse_run_folder(folder: Path) -> None:
    """Raise BundleError, which names the checkpoint, if it is the folder of a training run."""
    last = folder / "checkpoints" / "last.ckpt"
    if last.is_file():
        raise BundleError(f"{folder} is the folder of a training run, no model bundle; give its checkpoint, {last}")


def _without_duplicates(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    found = dict(pairs)
    if len(found) < len(pairs):
        twice = next(key for number, (key, _) in enumerate(pairs) if key in dict(pairs[:number]))
        raise ValueError(f"key `{printable(twice, LONGEST_REASON)}` is there twice")
    return found


def _no_number(word: str) -> Any:
    raise ValueError(f"{word} is not a number")
