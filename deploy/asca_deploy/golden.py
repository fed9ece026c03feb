"""Golden vectors: inputs and outputs of a bundle's stages for one scan, for testing runtimes in other languages.

    golden.json                 the bundle, the scan, and of each stage the arrays by name, with their files
    STAGE.NAME.npy              one array each, NumPy's format 1.0, little-endian, C order

A stage's inputs are the outputs of the stages before it. docs/BUNDLE.md says what each array is and how near a runtime
should come.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from asca_deploy.bundle import PillarBundle
from asca_deploy.detector import Detector
from asca_deploy.pillar.encoder import PILLAR_MAXIMA
from asca_deploy.pillar.graphs import HeadOutputs
from asca_deploy.pillar.pipeline import Canvas, PillarPipeline
from asca_deploy.two_stage.pipeline import RefinePipeline, refine_inputs
from asca_pillars.base.errors import BundleError
from asca_pillars.base.files import atomic_directory, write_json
from asca_pillars.base.own_files import json_object, require_not_input, require_replaceable
from asca_pillars.base.system import cpu_model, package_versions
from asca_pillars.detection.decode import HeadMaps, decode_candidates, sigmoid, suppress
from asca_pillars.detection.detections import Detections
from asca_pillars.ops.pillar.neck_rulebooks import rulebook_inputs
from asca_pillars.ops.two_stage.decode import reported_detections
from asca_pillars.ops.two_stage.first_stage import FirstStageOutputs, second_stage_inputs
from asca_pillars.ops.two_stage.prepare import refine_scan
from asca_pillars.scans.scan_reader import read_scan

GOLDEN = "golden.json"
GOLDEN_FOLDER = ("asca export --golden", GOLDEN, json_object("schema_version", "bundle", "scan", "stages"))
"""Command, marker and its recognizer, as `atomic_directory` takes them."""
SCHEMA_VERSION = 1

Stages: TypeAlias = Mapping[str, Mapping[str, NDArray[Any]]]


def write_golden(out: Path, bundle: str | Path | None, scan: Path) -> Stages:
    """Run a bundle on one scan and write what every stage gave.

    Args:
        out: folder: absent, empty, or an earlier output of this function.
        bundle: folder, or name of one that ships; None for the default one.
        scan: a file that `read_scan` reads.

    Returns:
        What was written, see `golden_stages`.

    Raises:
        BundleError: the bundle cannot be used.
        ScanError: the scan cannot be read.
        OutputError: `out` holds something else, the bundle or the scan.
    """
    require_replaceable(out, *GOLDEN_FOLDER)
    require_not_input(out, (bundle, scan))
    detector = Detector(bundle, threads=1)
    described = detector.bundle
    if not (isinstance(described, PillarBundle) and isinstance(detector.pipeline, PillarPipeline | RefinePipeline)):
        raise BundleError(f"{bundle}: golden vectors are written of pillar detectors, and this is {described.kind}")
    stages = golden_stages(detector.pipeline, read_scan(scan).points)
    with atomic_directory(out, *GOLDEN_FOLDER) as folder:
        for stage, arrays in stages.items():
            for name, array in arrays.items():
                np.save(folder / _file(stage, name), np.ascontiguousarray(array), allow_pickle=False)
        write_json(folder / GOLDEN, _contents(described, scan, stages))
    return stages


def golden_stages(pipeline: PillarPipeline | RefinePipeline, points: NDArray[np.float32]) -> Stages:
    """Return the arrays of each stage, by stage and name, for finite points (N, 4), metres, reflectance within 0..1.

    Stages, for M points in P pillars: `input`, `pillarize`, `pfn` (where it has a graph), `encode`, `scatter` (or
    `rulebooks` of a sparse neck), `neck+head`, `decode` (n boxes that enter suppression) and `suppress` (those that are
    reported). With a second stage, after `neck+head`: `propose`, `neighbors`, `refine` and `suppress`. Maps are
    channels last, as the graph gives them.
    """
    first = pipeline if isinstance(pipeline, PillarPipeline) else pipeline.first
    pillars = first.pillarize(points)
    features = first.encode(pillars)
    placed = first.backbone.place(features, pillars.cells)
    stages: dict[str, Mapping[str, NDArray[Any]]] = {
        "input": {"points": points},
        "pillarize": {
            "features": pillars.features,
            "pillar_index": pillars.pillar_index,
            "point_counts": pillars.point_counts,
            "cells": pillars.cells,
        },
        **({} if first.encode.pfn is None else {"pfn": {PILLAR_MAXIMA: first.encode.maxima(pillars)}}),
        "encode": {"pillar_features": features},
        # Before the canvas is used for the next scan.
        ("scatter" if first.bundle.pillar.neck == "dense" else "rulebooks"): _placed(placed),
    }
    if isinstance(pipeline, RefinePipeline):
        return {**stages, **_second_stage(pipeline, first.backbone.infer_with_neck(placed), points)}
    spec, answer = pipeline.spec, pipeline.backbone.run(placed)
    candidates = decode_candidates(
        answer.maps, spec.anchors, spec.classes, spec.post, answer.cells, spec.direction_offset_rad
    )
    boxes: dict[str, NDArray[Any]] = {
        "boxes": candidates.boxes,
        "scores": sigmoid(candidates.logits),
        "labels": candidates.labels,
    }
    detections = suppress(candidates, spec.classes, spec.post)
    return {**stages, "neck+head": _head_arrays(answer), "decode": boxes, "suppress": _detections(detections)}


def _second_stage(pipeline: RefinePipeline, first: FirstStageOutputs, points: NDArray[np.float32]) -> Stages:
    proposed = second_stage_inputs(first, points, pipeline.spec, pipeline.section.seen)
    scan = refine_scan(points, proposed, proposed.proposals, pipeline.section.neighbors)
    inputs = refine_inputs(scan)
    confidence, residuals = pipeline.refine(inputs)
    detections = reported_detections(proposed.proposals, confidence, residuals, pipeline.spec, pipeline.section.scores)
    return {
        "neck+head": {**_head_arrays(HeadOutputs(first.maps, first.cells)), "neck": first.neck},
        "propose": _detections(proposed.proposals),
        "neighbors": inputs,
        "refine": {"confidence": confidence, "residuals": residuals},
        "suppress": _detections(detections),
    }


def _detections(detections: Detections) -> dict[str, NDArray[Any]]:
    return {"boxes": detections.boxes, "scores": detections.scores, "labels": detections.labels}


def _placed(placed: Any) -> dict[str, NDArray[Any]]:
    """Return placed pillars: of a canvas, the occupied `rows` (n,) of (cells, C) and their `values` (n, C)."""
    if isinstance(placed, Canvas):
        values = placed.image.reshape(-1, placed.image.shape[-1])[placed.occupied]
        return {"rows": placed.occupied.copy(), "values": values}
    return {"pillar_features": placed.features, **rulebook_inputs(placed.rulebooks)}


def _head_arrays(answer: HeadOutputs) -> dict[str, NDArray[Any]]:
    if answer.cells is None:
        return {name: part.transpose(1, 2, 0) for name, part in zip(HeadMaps._fields, answer.maps, strict=True)}
    return {**dict(zip(HeadMaps._fields, answer.maps, strict=True)), "cells": answer.cells}


def _contents(bundle: PillarBundle, scan: Path, stages: Stages) -> dict[str, Any]:
    return {
        "schema_version": SCHEMA_VERSION,
        "bundle": bundle.name,
        "precision": bundle.precision,
        "graphs": {name: graph.sha256 for name, graph in bundle.graphs.items()},
        "scan": scan.name,
        "stages": [
            {
                "stage": stage,
                "arrays": {
                    name: {"file": _file(stage, name), "type": str(array.dtype), "shape": list(array.shape)}
                    for name, array in arrays.items()
                },
            }
            for stage, arrays in stages.items()
        ],
        "versions": package_versions(),
        "machine": cpu_model(),
    }


def _file(stage: str, name: str) -> str:
    return f"{stage.replace('+', '_')}.{name}.npy"
