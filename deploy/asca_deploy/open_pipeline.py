"""Choice of the pipeline for a bundle, by its family, and of its provider."""

from pathlib import Path
from typing import Any, Literal

from asca_deploy import auto, providers
from asca_deploy.bundle import Bundle, PillarBundle, PvRcnnBundle
from asca_deploy.pillar.pipeline import PillarPipeline
from asca_deploy.pipeline import Pipeline, StageTimes
from asca_deploy.pv_rcnn.pipeline import PvRcnnPipeline
from asca_deploy.shipped import sample_scan_path
from asca_deploy.two_stage.pipeline import RefinePipeline
from asca_pillars.detection.detections import Detections
from asca_pillars.scans.scan_reader import read_scan


def open_pipeline(
    folder: Path,
    bundle: Bundle,
    provider: providers.Provider | Literal["auto"],
    precision: providers.Precision | None,
    threads: int,
) -> auto.Choice[Pipeline[Any, Any]]:
    """Open the pipeline of a bundle's family on a provider or, with auto, on the fastest that agrees.

    Args:
        folder: of the bundle.
        bundle: its manifest, verified by `load_bundle`.
        provider, threads: of the slowest network.
        precision: None for float32, with auto for any.

    Raises:
        BundleError: a graph cannot be run or does not match the manifest.
        ProviderError: the provider does not start or cannot run the graph; with auto, none can be taken.
    """

    def open_on(name: providers.Provider, digits: providers.Precision) -> Pipeline[Any, Any]:
        if isinstance(bundle, PvRcnnBundle):
            return PvRcnnPipeline(folder, bundle, name, digits, threads)
        assert isinstance(bundle, PillarBundle), "there are no other kinds"
        family = PillarPipeline if bundle.kind == "pillar" else RefinePipeline
        return family(folder, bundle, name, digits, threads)

    if provider != providers.AUTO:
        digits = precision or "float32"
        return auto.Choice(open_on(provider, digits), provider, digits, ())
    points = read_scan(sample_scan_path()).points

    def detect(pipeline: Pipeline[Any, Any]) -> Detections:
        stage_times: StageTimes = []
        return pipeline.finish(pipeline.infer(pipeline.prepare(points, stage_times), stage_times), stage_times)

    return auto.choose(providers.available(), open_on, detect, bundle.spec, precision, weights=bundle.precision)
