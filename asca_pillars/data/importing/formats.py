"""Label formats by name: those `asca import --from` reads, and those `asca detect --write` writes.

To add one, write a module with its functions and add an entry here. Modules are imported on first use.
"""

import importlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from asca_pillars.base.progress import SILENT, Reporter

if TYPE_CHECKING:
    from asca_pillars.data.importing.imported import Imported
    from asca_pillars.data.importing.tool_labels import ScanLabels
    from asca_pillars.scans.scan_settings import ScanSettings

_PACKAGE = "asca_pillars.data.importing"


@dataclass(frozen=True, kw_only=True)
class LabelFormat:
    """Label format.

    Attributes:
        help: description of SOURCE for the command line.
        reads: "module:function" of this package; called with the source, and with arguments as the next two state.
        scans_elsewhere: the function also takes `scans` and `settings`, since the labels do not state the scans' place.
        writes_scans: the function also takes `out`, since the scans are in files of another format.
        writes: "module:function" that returns the files of a tool's labels; None if the format cannot be written.
        extra: optional dependencies of this package that it needs.
    """

    help: str
    reads: str
    scans_elsewhere: bool = False
    writes_scans: bool = False
    writes: str | None = None
    extra: str | None = None

    def read(
        self,
        source: Path,
        *,
        out: Path,
        scans: Path | None,
        settings: "ScanSettings",
        reporter: Reporter = SILENT,
    ) -> "Imported":
        """Read the frames of the source.

        Args:
            source: the file or folder.
            out: output folder of the dataset.
            scans: folder of the scans, if `scans_elsewhere`.
            settings: settings of those scans.
            reporter: told of each part that is read, where it takes long.

        Raises:
            DatasetError: the source is not of this format.
        """
        arguments: dict[str, Any] = {"scans": scans, "settings": settings}
        if not self.scans_elsewhere:  # a dataset of its own
            arguments = {"reporter": reporter}
        if self.writes_scans:
            arguments["out"] = out
        return _function(self.reads)(source, **arguments)

    def files(self, frames: Sequence["ScanLabels"]) -> Mapping[str, str]:
        """Return the tool's files as texts by relative paths.

        Raises:
            OutputError: the format cannot represent a label.
        """
        assert self.writes is not None
        return _function(self.writes)(frames)


def _function(place: str) -> Any:
    module, _, name = place.partition(":")
    return getattr(importlib.import_module(f"{_PACKAGE}.{module}"), name)


def _tool(module: str, name: str, help_text: str) -> LabelFormat:
    """Return the format of a labelling tool: read and written, with its scans elsewhere."""
    return LabelFormat(
        help=help_text, reads=f"{module}:read_{name}", writes=f"{module}:write_{name}", scans_elsewhere=True
    )


FORMATS: Mapping[str, LabelFormat] = {
    "boxes": LabelFormat(
        help=".csv or .jsonl for all scans, or a folder with a .csv or .json for each (docs/DATA.md)",
        reads="tool_labels:read_box_files",
        scans_elsewhere=True,
    ),
    "labelcloud": _tool("labelcloud", "labelcloud", "labelCloud's labels/ (centroid_abs or centroid_rel)"),
    "sustechpoints": _tool("sustechpoints", "sustechpoints", "label/ of a scene, or the folder of several"),
    "supervisely": _tool("supervisely", "supervisely", "a point cloud project: meta.json and <dataset>/ann/"),
    "cvat": _tool("supervisely", "cvat", "an export as Sly Point Cloud Format 1.0, unpacked"),
    "openpcdet": _tool("text_labels", "openpcdet", "labels/ of a custom dataset (.txt)"),
    "kitti-no-camera": _tool("text_labels", "kitti_no_camera", "KITTI's text with boxes in the LiDAR frame (.txt)"),
    "argoverse2": LabelFormat(help="a folder of logs", reads="argoverse2:read_argoverse2", extra="import"),
    "nuscenes": LabelFormat(help="the folder with samples/ and v1.0-*/", reads="nuscenes:read_nuscenes"),
    "waymo": LabelFormat(
        help="the folder with lidar/, lidar_box/ and lidar_calibration/ (parquet)",
        reads="waymo_parquet:read_waymo",
        writes_scans=True,
        extra="import",
    ),
    "kitti-raw": LabelFormat(help="a folder of drives with their tracklets", reads="kitti_raw:read_kitti_raw"),
    "kitti-tracking": LabelFormat(help="the folder with training/", reads="kitti_tracking:read_kitti_tracking"),
}
TOOLS = tuple(name for name, form in FORMATS.items() if form.writes is not None)
"""Names of the labelling tools' formats, which are both read and written."""
