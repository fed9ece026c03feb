"""Which paths are recordings, and opening them."""

import re
from pathlib import Path

from asca_pillars.data.recordings.mcap_files import McapRecording
from asca_pillars.data.recordings.recording import Recording
from asca_pillars.data.recordings.ros_bags import RosBag
from asca_pillars.data.scans.find_scans import is_scan, natural_order, visible_files
from asca_pillars.errors import ScanError

RECORDING_SUFFIXES = (".mcap", ".db3", ".bag")
METADATA_FILE, METADATA_KEY = "metadata.yaml", "rosbag2_bagfile_information"


def is_recording(path: Path) -> bool:
    """Whether it is a recording by its name: a file, or a folder with the metadata.yaml or the files of rosbag2."""
    if path.is_dir():
        return _has_metadata(path) or bool(_files(path))
    return path.suffix.lower() in RECORDING_SUFFIXES


def recording_files(path: Path) -> list[Path]:
    """The files that a recording consists of, sorted; a folder may hold others, such as results."""
    if not path.is_dir():
        return [path]
    names = METADATA_FILE, *(f"*{suffix}*" for suffix in (".mcap", ".db3"))  # compressed ones have two suffixes
    return sorted(file for name in names for file in visible_files(path, name) if file.is_file())


def open_recording(path: Path) -> Recording:
    """Open a recording.

    Raises:
        ScanError: nothing is there, it cannot be read, or it lies among scans.
    """
    if not path.exists():
        raise ScanError(f"{path}: no such file or folder; check the path")
    if path.is_dir():
        files = _files(path)
        if not _has_metadata(path):
            if scan := next((file for file in sorted(path.iterdir()) if is_scan(Path(file.name))), None):
                raise ScanError(f"{path}: holds {files[0].name} and scans such as {scan.name}; give one or the other")
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


def _has_metadata(folder: Path) -> bool:
    """Whether there is rosbag2's metadata.yaml; others use that name, too."""
    path = folder / METADATA_FILE
    return path.is_file() and METADATA_KEY in path.read_text(encoding="utf-8", errors="replace")


def _is_compressed(metadata: Path) -> bool:
    """Whether rosbag2 compressed the messages or files of a recording, which it writes nowhere else."""
    text = metadata.read_text(encoding="utf-8", errors="replace")
    return re.search(r"""compression_mode:\s*['"]?(message|file)""", text, re.IGNORECASE) is not None


def _files(folder: Path) -> list[Path]:
    found = [file for suffix in (".mcap", ".db3") for file in visible_files(folder, f"*{suffix}")]
    return sorted(found, key=lambda file: natural_order(Path(file.name)))
