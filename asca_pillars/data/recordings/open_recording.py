"""Which paths are recordings, and opening them."""

import re
from pathlib import Path

from asca_pillars.data.recordings.mcap_files import McapRecording
from asca_pillars.data.recordings.recording import Recording
from asca_pillars.data.recordings.ros_bags import RosBag
from asca_pillars.data.scans.find_scans import natural_order
from asca_pillars.errors import ScanError

RECORDING_SUFFIXES = (".mcap", ".db3", ".bag")
METADATA_FILE = "metadata.yaml"


def is_recording(path: Path) -> bool:
    """Whether it is a recording by its name: a file, or a folder with the metadata.yaml or the files of rosbag2."""
    if path.is_dir():
        return (path / METADATA_FILE).is_file() or bool(_files(path))
    return path.suffix.lower() in RECORDING_SUFFIXES


def open_recording(path: Path) -> Recording:
    """Open a recording.

    Raises:
        ScanError: nothing is there, or it cannot be read.
    """
    if not path.exists():
        raise ScanError(f"{path}: no such file or folder; check the path")
    if path.is_dir():
        files = _files(path)
        if not (path / METADATA_FILE).is_file():
            if len(files) == 1:
                return open_recording(files[0])
            raise ScanError(
                f"{path}: {len(files)} recordings, and no {METADATA_FILE} that would make one of them; give one of them"
            )
        # The format's own library reads on where a file is damaged, and knows nothing of rosbag2's compression.
        plain_mcap = {file.suffix for file in files} == {".mcap"} and not _is_compressed(path / METADATA_FILE)
        return McapRecording(path, files) if plain_mcap else RosBag(path)
    if path.stat().st_size == 0:
        raise ScanError(f"{path}: the file is empty (0 bytes); copy or record it again")
    return McapRecording(path, [path]) if path.suffix.lower() == ".mcap" else RosBag(path)


def _is_compressed(metadata: Path) -> bool:
    """Whether rosbag2 compressed the messages or files of a recording, which it writes nowhere else."""
    text = metadata.read_text(encoding="utf-8", errors="replace")
    return re.search(r"""compression_mode:\s*['"]?(message|file)""", text, re.IGNORECASE) is not None


def _files(folder: Path) -> list[Path]:
    found = [file for suffix in (".mcap", ".db3") for file in folder.glob(f"*{suffix}")]
    return sorted(found, key=lambda file: natural_order(Path(file.name)))
