"""What `asca eval` leaves of a model in its folder, for tests of evaluating something else into it."""

import json
from pathlib import Path


def earlier_predictions(out: Path, texts: Path | None = None) -> Path:
    """The folder `predictions` of an earlier run, with the files of `texts` or a file of its own."""
    folder = out / "predictions"
    folder.mkdir(parents=True)
    contents = {"000009.txt": ""} if texts is None else {path.name: path.read_text() for path in texts.glob("*.txt")}
    for name, content in contents.items():
        (folder / name).write_text(content)
    (folder / "made_by.json").write_text(
        json.dumps({"model": {}, "data": "", "split": "val", "files": sorted(contents)})
    )
    return folder
