"""Detection and opening of recordings."""

import shutil
import weakref
from collections.abc import Callable
from pathlib import Path

from asca_pillars.base.errors import ScanError
from asca_pillars.base.input_files import require_content
from asca_pillars.base.progress import SILENT, Reporter
from asca_pillars.scans.find_scans import is_scan, natural_order, visible_files
from asca_pillars.scans.recordings.decompression import UNPACKERS, decompress_file
from asca_pillars.scans.recordings.mcap_files import McapRecording
from asca_pillars.scans.recordings.packet_files import PacketCapture
from asca_pillars.scans.recordings.recording import Recording
from asca_pillars.scans.recordings.ros_bags import RosBag
from asca_pillars.scans.recordings.rosbag2 import (
    METADATA_FILE,
    BagMetadata,
    SplitRecording,
    SqliteRecording,
    read_metadata,
)

_READERS: dict[str, Callable[[Path, Path | None], Recording]] = {
    ".mcap": McapRecording,
    ".db3": SqliteRecording,
    ".bag": RosBag,
    ".pcap": PacketCapture,
}
RECORDING_SUFFIXES = tuple(_READERS)
_ROSBAG2_SUFFIXES = (".mcap", ".db3")


def is_recording(path: Path) -> bool:
    """Return whether a path is a recording: by a file's name, or a folder's metadata.yaml or rosbag2 files."""
    if path.is_dir():
        return read_metadata(path) is not None or bool(_files(path))
    return _recorded_suffix(path) in RECORDING_SUFFIXES


def recording_files(path: Path) -> list[Path]:
    """Return the files of a recording, sorted; a folder may contain others, such as results."""
    if not path.is_dir():
        return [path]
    names = METADATA_FILE, *(f"*{suffix}*" for suffix in _ROSBAG2_SUFFIXES)  # compressed ones have two suffixes
    return sorted(file for name in names for file in visible_files(path, name) if file.is_file())


def open_recording(path: Path, reporter: Reporter = SILENT) -> Recording:
    """Open a recording; a large compressed file is unpacked, of which the reporter is told the progress.

    Raises:
        ScanError: it does not exist, cannot be read, or lies among scans.
    """
    if not path.exists():
        raise ScanError(f"{path}: no such file or folder; check the path")
    if not path.is_dir():
        return _open_file(path, reporter)
    files, metadata = _files(path), read_metadata(path)
    if metadata is not None:
        return _open_rosbag2(path, files, metadata, reporter)
    if scan := next((file for file in sorted(path.iterdir()) if is_scan(Path(file.name))), None):
        raise ScanError(f"{path}: holds {files[0].name} and scans such as {scan.name}; give one or the other")
    if len(files) > 1:
        raise ScanError(
            f"{path}: {len(files)} recordings, and no {METADATA_FILE} that would make one of them; give one of them"
        )
    return _open_file(files[0], reporter)


def _open_rosbag2(folder: Path, there: list[Path], metadata: BagMetadata, reporter: Reporter) -> Recording:
    """Open the listed files, or all if none of them is there; errors in some do not lose the others."""
    by_name = {_unpacked_name(path.name): path for path in there}
    listed = {name: by_name.get(_unpacked_name(name)) for name in metadata.files}
    if packed := [name for name, file in listed.items() if file is None and (folder / name).is_file()]:
        raise ScanError(f"{folder}: {packed[0]} is packed, and {', '.join(UNPACKERS)} are read; unpack it there")
    troubles = [f"{folder}: {name} is missing" for name, file in listed.items() if file is None]
    if len(troubles) == len(listed):
        troubles, listed = [], {file.name: file for file in there}
    recordings = []
    for file in filter(None, listed.values()):
        try:
            recordings.append(_open_file(file, reporter))
        except ScanError as error:
            troubles.append(str(error))
    if not recordings:
        missing = f"{folder}: none of its recording's files is there ({', '.join(metadata.files)[:80]})"
        raise ScanError(troubles[0] if troubles else f"{missing}; copy the whole folder")
    return SplitRecording(folder, recordings, metadata.counts, troubles[0] if troubles else None)


def _open_file(path: Path, reporter: Reporter) -> Recording:
    require_content(path, ScanError)
    try:
        if path.stat().st_size == 0:
            raise ScanError(f"{path}: the file is empty (0 bytes); copy or record it again")
        reader = _READERS[_recorded_suffix(path)]
        if path.suffix.lower() not in UNPACKERS:
            return reader(path, None)
        copy = decompress_file(path, reporter)
        try:
            recording = reader(path, copy)
        except BaseException:
            shutil.rmtree(copy.parent, ignore_errors=True)
            raise
    except OSError as error:
        raise ScanError(f"{path}: cannot be read ({error.strerror or error}); check the path") from None
    recording.notes = (f"{path}: unpacked to {copy.parent} for this run ({copy.stat().st_size / 2**20:.1f} MiB)",)
    weakref.finalize(recording, shutil.rmtree, copy.parent, ignore_errors=True)
    return recording


def _recorded_suffix(path: Path) -> str:
    """Return the suffix of a file, without that of its compression."""
    return Path(_unpacked_name(path.name)).suffix.lower()


def _unpacked_name(name: str) -> str:
    """Return the name of a file without the suffix of its compression."""
    return Path(name).stem if Path(name).suffix.lower() in UNPACKERS else name


def _files(folder: Path) -> list[Path]:
    """Return the rosbag2 files of a folder, in natural order; a decompressed copy replaces its compressed file."""
    found = [file for suffix in _ROSBAG2_SUFFIXES for file in visible_files(folder, f"*{suffix}*")]
    found = [file for file in found if _recorded_suffix(file) in _ROSBAG2_SUFFIXES and not file.is_dir()]
    plain = {file.name for file in found if file.name == _unpacked_name(file.name)}
    chosen = {file for file in found if file.name in plain or _unpacked_name(file.name) not in plain}
    return sorted(chosen, key=lambda file: natural_order(Path(file.name)))
