"""Whether a wheel holds what an installation needs: python .ci/check_wheel.py dist/asca_pillars-*.whl."""

import sys
import zipfile
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
PLACES = {
    "configs": "asca_pillars/configs",
    "asca_pillars": "asca_pillars",
    "deploy/asca_deploy": "asca_deploy",
    "export/asca_export": "asca_export",
}
"""Folders of the repository, and where the wheel has them."""
LARGEST_MB = 100  # of a file on PyPI


def main(wheel: Path) -> None:
    """Print what is missing, or too much, and exit with 1."""
    found = set(zipfile.ZipFile(wheel).namelist())
    wrong = []
    for folder, place in PLACES.items():
        files = [path for path in (ROOT / folder).rglob("*") if path.is_file() and "__pycache__" not in path.parts]
        names = {f"{place}/{path.relative_to(ROOT / folder).as_posix()}" for path in files}
        wrong += [f"{name} is missing" for name in sorted(names - found)]
        found -= names
    information = {name for name in found if ".dist-info/" in name}
    if not any(name.endswith(".dist-info/licenses/LICENSE") for name in information):
        wrong.append("LICENSE is missing")
    wrong += [f"{name} does not belong there" for name in sorted(found - information)]
    if (size_mb := wheel.stat().st_size / 1e6) > LARGEST_MB:
        wrong.append(f"{size_mb:.0f} MB are too many")
    if wrong:
        sys.exit("\n".join(wrong))
    print(f"{wheel.name}: complete, {size_mb:.1f} MB")


if __name__ == "__main__":
    main(Path(sys.argv[1]))
