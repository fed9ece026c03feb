from pathlib import Path

import pytest

from asca_deploy.bundle import MANIFEST, SCHEMA_VERSION
from tests.deploy.edited_manifest import assert_refused, edit


@pytest.mark.parametrize("version", [None, "1", 1.0, True, [1]])
def test_no_usable_schema_version(bundle_copy: Path, version: object) -> None:
    edit(bundle_copy, lambda data: data.update(schema_version=version))
    assert_refused(bundle_copy, "`schema_version` is .*export the bundle again")


def test_newer_schema_version_is_said_before_anything_else(bundle_copy: Path) -> None:
    edit(bundle_copy, lambda data: data.update(schema_version=SCHEMA_VERSION + 1, graphs="packed"))
    assert_refused(bundle_copy, r"schema_version 4 is newer .*reads; upgrade with `git -C .* pull`")


def test_older_schema_version(bundle_copy: Path) -> None:
    edit(bundle_copy, lambda data: data.update(schema_version=1))
    assert_refused(bundle_copy, "schema_version 1 is no longer read; export the bundle again")


@pytest.mark.parametrize("text", ["", "{", "[1, 2]", '"bundle"', "null", "\xff"])
def test_a_manifest_that_is_no_manifest(bundle_copy: Path, text: str) -> None:
    (bundle_copy / MANIFEST).write_bytes(text.encode("latin-1"))
    assert_refused(bundle_copy, "is damaged|is not a bundle's manifest")


def test_no_bundle_there(tmp_path: Path) -> None:
    assert_refused(tmp_path / "nowhere", "is no model bundle.*asca export")
    assert_refused(tmp_path, "is no model bundle")
    checkpoint = tmp_path / "last.ckpt"
    checkpoint.write_bytes(b"weights")
    assert_refused(checkpoint, "is no model bundle")


def test_duplicate_keys_and_deep_nesting(bundle_copy: Path) -> None:
    text = (bundle_copy / MANIFEST).read_text()
    (bundle_copy / MANIFEST).write_text(text.replace('"name": "tiny"', '"name": "tiny", "name": "tiny"', 1))
    assert_refused(bundle_copy, "key `name` is there twice")
    for damaged in ("[" * 200_000, '{"a":' * 50_000, text.replace("0.1", "NaN", 1), text + " " * 2_000_000):
        (bundle_copy / MANIFEST).write_text(damaged)
        assert_refused(bundle_copy, "is damaged|is larger than a manifest")
