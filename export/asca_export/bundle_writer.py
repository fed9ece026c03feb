"""Common parts of the exports of all families: options, and a bundle that is written once its graphs are proven."""

import dataclasses
import datetime
import hashlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from asca_deploy.bundle import Bundle, Parity, Provenance
from asca_deploy.manifest import load_bundle, write_bundle_manifest
from asca_export import graphs
from asca_pillars.base.errors import ExportError
from asca_pillars.base.files import WEIGHTS_FILE
from asca_pillars.base.system import cpu_model, git_revision, package_versions
from asca_pillars.detection.spec import DetectorSpec
from asca_pillars.models.build import Checkpoint
from asca_pillars.models.checkpoint_file import save_weights, weights_sha256
from asca_pillars.scans.input_check import measure_expected_input

MIN_SCANS = 8
LICENSE = "Apache-2.0"

B = TypeVar("B", bound=Bundle)


def _ignore_progress(_: str) -> None:
    pass


@dataclass(frozen=True)
class ExportOptions:
    """Options of the export of a checkpoint.

    Attributes:
        trained_on: what the weights have seen, in words, for the manifest.
        command: the command that trained them.
        calibration: scans (N, 4), metres, LiDAR frame, and reflectance, that set the ranges of an 8-bit bundle; those
            that parity is proven on are left out and counted. None exports in float32.
        dense_neck: write a sparse neck as dense convolutions with masks, in float32 alone, see `fast_forms`.
        weights: the checkpoint's file, whose weights are to lie beside the graphs in 16 bits; None leaves them out.
        progress: called with a description of each step.
    """

    trained_on: str = "not stated"
    command: str = "not stated"
    calibration: Sequence[NDArray[np.float32]] | None = None
    dense_neck: bool = False
    weights: Path | None = None
    progress: Callable[[str], None] = _ignore_progress


DEFAULTS = ExportOptions()


def require_parity_scans(scans: Sequence[NDArray[np.float32]]) -> None:
    """Refuse to prove parity on fewer than MIN_SCANS scans (N, 4), metres, LiDAR frame.

    Raises:
        ExportError: there are fewer.
    """
    if len(scans) < MIN_SCANS:
        raise ExportError(f"{len(scans)} scans given to prove parity on, at least {MIN_SCANS} are needed; add --scans")


def draft_bundle(
    bundle_type: Callable[..., B],
    spec: DetectorSpec,
    checkpoint: Checkpoint,
    scans: Sequence[NDArray[np.float32]],
    options: ExportOptions,
    **sections: Any,
) -> B:
    """Return the manifest of a checkpoint in float32, without graphs and parity.

    Args:
        bundle_type: of its family.
        spec: of the detector.
        checkpoint: whose weights it holds.
        scans: (N, 4) each; if the checkpoint does not say what its training scans looked like, these stand in for them.
        options: of the export.
        sections: fields of the family.
    """
    config, expected = checkpoint.config, checkpoint.expected_input
    return bundle_type(
        name=config.name,
        spec=spec,
        precision="float32",
        graphs={},
        parity=None,
        quantization=None,
        expected_input=expected or measure_expected_input(scans, config.data.camera_view),
        expected_input_from="training" if expected else "export",
        provenance=Provenance(
            command=options.command,
            created=datetime.datetime.now(datetime.UTC).date().isoformat(),
            git_revision=git_revision(),
            trained_on=options.trained_on,
            seed=config.train.seed,
            steps=checkpoint.steps,
            versions=package_versions(),
            machine=cpu_model(),
            weights_sha256=weights_sha256(checkpoint.detector.state_dict()),
        ),
        license=LICENSE,
        **sections,
    )


def write_bundle(folder: Path, draft: B, compare: Callable[[B], Parity], weights: Path | None) -> B:
    """Sign the graphs in `folder`; write their manifest with the parity that `compare` finds as the runtime opens it.

    Args:
        folder: with the graphs.
        draft: the manifest.
        compare: compares the opened bundle with PyTorch.
        weights: as in `ExportOptions`.

    Raises:
        ExportError: there is no parity.
    """
    if weights is not None:
        save_weights(weights, folder / WEIGHTS_FILE)
        digest = hashlib.sha256((folder / WEIGHTS_FILE).read_bytes()).hexdigest()
        kept = dataclasses.replace(draft.provenance, weights_file=WEIGHTS_FILE, weights_file_sha256=digest)
        draft = dataclasses.replace(draft, provenance=kept)
    signed = graphs.sign(folder, draft)
    write_bundle_manifest(folder, signed)
    opened = load_bundle(folder)
    assert isinstance(opened, type(draft)), "as it was written"
    bundle = dataclasses.replace(signed, parity=compare(opened))
    write_bundle_manifest(folder, bundle)
    return bundle
