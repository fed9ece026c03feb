"""Folders of rosbag2: a recording in several consecutive files, and its metadata.yaml."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import yaml

from asca_pillars.base.settings import MAX_CHARACTERS, parse_yaml
from asca_pillars.scans.recordings.recording import Message, Recording, merge_topics

METADATA_FILE = "metadata.yaml"
_KEY = "rosbag2_bagfile_information"


@dataclass(frozen=True)
class BagMetadata:
    """Names of files and the number of messages of each topic, as far as a metadata.yaml states them."""

    files: tuple[str, ...] = ()
    counts: Mapping[str, int] = field(default_factory=dict)


def read_metadata(folder: Path) -> BagMetadata | None:
    """Read the folder's metadata.yaml; return None if it is missing, or not one of rosbag2."""
    path = folder / METADATA_FILE
    if not path.is_file():
        return None
    with path.open("rb") as file:
        text = file.read(4 * MAX_CHARACTERS).decode("utf-8-sig", errors="replace")
    if _KEY not in text:
        return None
    try:
        content = parse_yaml(text)[_KEY]
        names = tuple(Path(str(name)).name for name in content.get("relative_file_paths") or ())
        counts = {
            str(one["topic_metadata"]["name"]): int(one["message_count"])
            for one in content.get("topics_with_message_count") or ()
        }
    except (yaml.YAMLError, ValueError, TypeError, KeyError, AttributeError, RecursionError):
        return BagMetadata()
    return BagMetadata(names, counts)


class SplitRecording(Recording):
    """Files of a folder as one recording.

    Args:
        path: the folder.
        files: files in their order.
        counts: stated number of messages of each topic.
        trouble: error of files that are not among these; None: none.
    """

    def __init__(
        self, path: Path, files: Sequence[Recording], counts: Mapping[str, int], trouble: str | None = None
    ) -> None:
        self.path, self._files, self._counts, self._trouble = path, files, counts, trouble
        self.topics = merge_topics(topic for file in files for topic in file.topics)
        self.notes = tuple(note for file in files for note in file.notes)
        self.damage = trouble or next((file.damage for file in files if file.damage), None)

    def messages(self, topic: str) -> Iterator[Message]:
        """Yield the messages of a topic, file by file; damage in one does not end the recording."""
        self.damage, count = self._trouble, 0
        for file in self._files:
            if all(one.name != topic for one in file.topics):
                continue
            for message in file.messages(topic):
                count += 1
                yield message
            self.damage = self.damage or file.damage
        if self.damage is None and count < (declared := self._counts.get(topic, 0)):
            self.damage = f"{self.path}: {count} of the {declared} messages of {topic} can be read"
