"""Proposals of a first stage for every frame of a split, computed once: the first stage is frozen meanwhile."""

import hashlib
import json
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from zipfile import BadZipFile

import numpy as np
from numpy.typing import NDArray

from asca_pillars.base.errors import DatasetError
from asca_pillars.base.processes import map_in_processes
from asca_pillars.base.progress import SILENT, Reporter
from asca_pillars.base.schema import to_dict
from asca_pillars.data.frames import LabeledSplit
from asca_pillars.data.insertion.prepared import require_writable, writable_atomic_path
from asca_pillars.detection.detections import Detections
from asca_pillars.ops.two_stage.first_stage import FirstStage, FirstStageSettings, SecondStageInputs, run_first_stage

_FORMAT = 3  # format of the files; with another number, old ones are not read


@dataclass(frozen=True)
class ProposalFiles:
    """The files of a cache; loader processes read them without the first stage."""

    folder: Path
    class_names: tuple[str, ...]

    def read(self, frame_id: str) -> SecondStageInputs:
        """Read the first-stage results of a frame.

        Raises:
            DatasetError: its file is missing or damaged.
        """
        path = self.path(frame_id)
        try:
            # Opened here: NumPy leaves a file that it cannot read open.
            with path.open("rb") as file, np.load(file, allow_pickle=False) as arrays:
                detections = Detections(arrays["boxes"], arrays["scores"], arrays["labels"], self.class_names)
                return SecondStageInputs(detections, arrays["keypoints"], arrays["bev"].astype(np.float32))
        except FileNotFoundError:
            raise DatasetError(f"{path}: no proposals of this frame; compute them first") from None
        except (OSError, ValueError, KeyError, EOFError, BadZipFile) as error:
            raise DatasetError(f"{path}: damaged ({error}); delete it, it will be computed again") from None

    def path(self, frame_id: str) -> Path:
        """Return the path of the frame's file."""
        return self.folder / f"{frame_id}.npz"


class ProposalCache:
    """Files below `prepared`/proposals-KEY, one for each frame; KEY names the first stage and the settings.

    Each file records the state of its frame's points (`points_state`), so that changed frames are detected.

    Args:
        prepared: folder of what is computed once per dataset, see `data.insertion.prepared`.
        pool: what the frames' names are unique in.
        stage: the first stage; can be sent to a process, where several fill the cache.
        camera_view: whether the first stage sees only the points in the image.
    """

    def __init__(
        self, prepared: Path, pool: str, stage: FirstStage, settings: FirstStageSettings, *, camera_view: bool = True
    ) -> None:
        self.prepared, self.stage, self.settings, self.camera_view = prepared, stage, settings, camera_view
        about = {"format": _FORMAT, "stage": stage.identity, "spec": to_dict(stage.spec), "camera_view": camera_view}
        about |= to_dict(settings)
        key = hashlib.sha256(json.dumps(about, sort_keys=True).encode()).hexdigest()[:12]
        self.files = ProposalFiles(prepared / pool / f"proposals-{key}", stage.spec.class_names)

    def fill(self, split: LabeledSplit, *, workers: int = 1, reporter: Reporter = SILENT) -> None:
        """Compute what is missing or outdated. Each file appears when it is complete, so a killed run can be resumed.

        Args:
            split: frames.
            workers: processes; each opens the first stage for itself.
            reporter: for the progress.

        Raises:
            DatasetError, ScanError: a frame cannot be read, or a file not written.
        """
        todo = [frame_id for frame_id in split.frame_ids if not self._is_current(split, frame_id)]
        if todo:
            require_writable(self.prepared)
        propose = partial(_propose, self.files, split, self.stage, self.settings, self.camera_view)
        for _ in map_in_processes(propose, todo, workers, "Proposing", reporter=reporter):
            pass

    def _is_current(self, split: LabeledSplit, frame_id: str) -> bool:
        """Return whether the frame's file was made from its scan as it is; only the file's stamp is read."""
        try:
            with self.files.path(frame_id).open("rb") as file, np.load(file, allow_pickle=False) as arrays:
                return np.array_equal(arrays["stamp"], _stamp(split, frame_id))
        except (OSError, ValueError, KeyError, EOFError, BadZipFile):  # none there, or a damaged one: it is made again
            return False


def _propose(
    files: ProposalFiles,
    split: LabeledSplit,
    stage: FirstStage,
    settings: FirstStageSettings,
    camera_view: bool,
    frame_id: str,
) -> None:
    stamp = _stamp(split, frame_id)  # before the scan is read: one that changes meanwhile is read again
    points = split.points(frame_id, camera_view=camera_view)
    found = run_first_stage(stage, points[np.isfinite(points).all(axis=1)], settings)
    with writable_atomic_path(files.path(frame_id)) as temporary, temporary.open("wb") as file:
        np.savez(file, allow_pickle=False, stamp=stamp, **_arrays(found))


def _stamp(split: LabeledSplit, frame_id: str) -> NDArray[np.int64]:
    """Return the state of the files that the proposals were made from; empty if one is missing."""
    try:
        return np.array(split.points_state(frame_id))
    except FileNotFoundError:  # reported, in words, by whoever reads it
        return np.zeros(0, np.int64)


def _arrays(found: SecondStageInputs) -> dict[str, NDArray[np.generic]]:
    proposals = found.proposals
    return {
        "boxes": proposals.boxes,
        "scores": proposals.scores,
        "labels": proposals.labels,
        "keypoints": found.keypoints,
        "bev": found.bev.astype(np.float16),  # the bulk of the file, and more digits than a feature is worth
    }
