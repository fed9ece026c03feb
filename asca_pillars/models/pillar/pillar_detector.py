"""The whole network between pillars and head maps, and its side of training (`models.trainable.Trainable`)."""

from collections.abc import Mapping, Sequence

from torch import Tensor, nn

from asca_pillars.config import LossConfig, PillarModel
from asca_pillars.geometry.decode import HeadMaps
from asca_pillars.geometry.detections import Detections
from asca_pillars.geometry.detector_spec import DetectorSpec
from asca_pillars.models.pillar.encoder import PillarEncoder
from asca_pillars.models.pillar.head import SSDHead
from asca_pillars.models.pillar.loss import detection_loss
from asca_pillars.models.pillar.neck import RPNNeck
from asca_pillars.models.pillar.pillar_preparation import LabeledPillars, PillarBatch, PillarPreparation
from asca_pillars.pillars.pillar_spec import PillarSpec


class PillarDetector(nn.Module):
    """ASCA-PointPillars (figure 1 of the paper); PointPillars with K = 1, V_max = 0.16 m and no CPA.

    Args:
        spec: grid, limits and classes that its parts were made for.
        loss_weights: what training weighs its terms with.
        encode: points of pillars to pillar features (section 3.2 and 3.3).
        neck: pseudo-image to features (section 3.4).
        head: features to head maps.
    """

    def __init__(
        self, spec: PillarSpec, loss_weights: LossConfig, encode: PillarEncoder, neck: RPNNeck, head: SSDHead
    ) -> None:
        super().__init__()
        self.grid = spec.grid
        self.preparation = PillarPreparation(spec)
        self.loss_weights = loss_weights
        self.encode = encode
        self.neck = neck
        self.head = head

    def forward(self, batch: PillarBatch) -> HeadMaps[Tensor]:
        """Pillars of B frames -> head maps (B, channels, H, W) of logits and residuals, see `HeadMaps`."""
        pillar_features = self.encode(
            batch.features, batch.pillar_index, batch.point_counts, batch.frame_pillars
        )  # (P, C)
        canvas = self.scatter(pillar_features, batch.cells, batch.frame_pillars)  # (B, C, ny, nx)
        maps: HeadMaps[Tensor] = self.head(self.neck(canvas))
        return maps

    def predict(self, batch: LabeledPillars) -> HeadMaps[Tensor]:
        """Head maps (B, channels, H, W) of logits and residuals of B labelled frames."""
        maps: HeadMaps[Tensor] = self(batch.pillars)
        return maps

    def loss(self, outputs: HeadMaps[Tensor], batch: LabeledPillars) -> Mapping[str, Tensor]:
        """Terms of the loss, eq. (15), by name, scalars, from head maps (B, channels, H, W); see `detection_loss`."""
        return detection_loss(outputs, batch.targets, self.loss_weights)._asdict()

    def detect(self, outputs: HeadMaps[Tensor], spec: DetectorSpec) -> list[Detections]:
        """Boxes in head maps (B, channels, H, W) for each frame, LiDAR frame, with the thresholds of `spec`."""
        arrays = [part.float().cpu().numpy() for part in outputs]
        return [spec.decode(HeadMaps(*frame)) for frame in zip(*arrays, strict=True)]

    def scatter(self, pillar_features: Tensor, cells: Tensor, frame_pillars: Sequence[int]) -> Tensor:
        """Put each pillar's features at its cell of an empty pseudo-image: (P, C) -> (B, C, ny, nx)."""
        ny, nx = self.grid.ny, self.grid.nx
        frames, channels = len(frame_pillars), pillar_features.shape[1]
        frame_starts = cells.new_tensor([frame * ny * nx for frame in range(frames)])
        row = cells + frame_starts.repeat_interleave(cells.new_tensor(frame_pillars))
        # Channels last in memory: a pillar is one contiguous row here, and convolutions on a CPU prefer it.
        canvas = pillar_features.new_zeros(frames * ny * nx, channels).index_put((row,), pillar_features)
        return canvas.view(frames, ny, nx, channels).permute(0, 3, 1, 2)


def build_pillar_detector(model: PillarModel) -> PillarDetector:
    """The network that `model` describes, with fresh random weights."""
    network, spec = model.network, model.spec
    neck = RPNNeck(network.pillar_channels, network.block_channels, network.block_convs, network.upsample_channels)
    return PillarDetector(
        spec=spec,
        loss_weights=model.loss,
        encode=PillarEncoder(network.pillar_channels, network.cpa, spec.limits),
        neck=neck,
        head=SSDHead(neck.out_channels, anchors_per_cell=spec.anchors.shape[2]),
    )
