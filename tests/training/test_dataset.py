"""Training samples from a made-up KITTI folder: which labels count, which points are read, how frames are batched."""

import dataclasses
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
from torch.utils._pytree import tree_leaves

from asca_pillars.base.errors import DatasetError
from asca_pillars.config.pillar import LossConfig, NetworkConfig, PillarModel
from asca_pillars.config.tree import Config, DataConfig
from asca_pillars.data.frames import LabeledFrame, LabeledSplit, read_frame
from asca_pillars.data.kitti import KittiObject, KittiSplit, in_image, objects_from_boxes, write_image_set, write_labels
from asca_pillars.detection.anchors import IGNORED
from asca_pillars.detection.targets import assign_targets
from asca_pillars.geometry.boxes import points_in_boxes
from asca_pillars.models.pillar.network import build_pillar_detector
from asca_pillars.models.pillar.preparation import LabeledPillars, PillarPreparation, Placement, TargetedPillars
from asca_pillars.ops.pillar.spec import PillarSpec
from asca_pillars.scans.scan_reader import write_scan
from asca_pillars.training.dataset import Batch, Collate, Sample, open_dataset
from tests.helpers.scenes import CALIBRATION, GRID, SPEC, make_scene, write_dataset

CONFIG = Config(model=PillarModel(spec=SPEC), data=DataConfig(train_set="train", val_set="val", workers=0))
DONT_CARE = KittiObject("DontCare", -1, -1, -10, (500, 150, 540, 190), -1, -1, -1, -1000, -1000, -1000, -10)


def read(split: LabeledSplit, config: Config, frame_id: str = "000000") -> LabeledFrame:
    data = config.data
    names = config.model.spec.class_names
    return read_frame(split, frame_id, names, camera_view=data.camera_view, min_points=data.min_points)


def with_data(**changes: object) -> Config:
    return dataclasses.replace(CONFIG, data=dataclasses.replace(CONFIG.data, **changes))  # type: ignore[arg-type]


def one_frame(root: Path, names: tuple[str, ...], extra: tuple[KittiObject, ...] = ()) -> tuple[KittiSplit, np.ndarray]:
    """A folder whose only frame holds one box of each name, and the boxes."""
    split = KittiSplit(write_dataset(root, 1))
    sizes_like = tuple(name if name in SPEC.class_names else "Car" for name in names)
    points, boxes, _ = make_scene(0, sizes_like)
    write_scan(split.scan_path("000000"), points)
    write_labels(split.label_path("000000"), [*objects_from_boxes(boxes, names, CALIBRATION), *extra])
    return split, boxes


def test_types_that_are_classes_neighbors_and_others(tmp_path: Path) -> None:
    names = ("Car", "Van", "Truck", "Pedestrian", "Person_sitting", "Cyclist", "Tram", "Misc")
    split, boxes = one_frame(tmp_path, names, extra=(DONT_CARE,))
    frame = read(split, CONFIG)
    assert frame.labels.tolist() == [0, IGNORED, 1, IGNORED, 2] and frame.labels.dtype == np.int64
    # The label file has two decimals.
    np.testing.assert_allclose(frame.boxes, boxes[[0, 1, 3, 4, 5]], atol=0.011)
    assert frame.frame_id == "000000" and frame.boxes.dtype == frame.points.dtype == np.float32
    for classes, expected in (
        (("Pedestrian",), [0, IGNORED]),  # without cars, a van is no class's neighbor
        (("Cyclist", "Car"), [1, IGNORED, 0]),
        (("Car", "Van"), [0, 1]),  # a class of its own is no neighbor
    ):
        named = tuple(dataclasses.replace(SPEC.classes[0], name=name) for name in classes)
        config = dataclasses.replace(CONFIG, model=PillarModel(spec=PillarSpec(grid=GRID, classes=named)))
        assert read(split, config).labels.tolist() == expected


def test_objects_with_too_few_points_are_neither_right_nor_wrong(tmp_path: Path) -> None:
    split, boxes = one_frame(tmp_path, ("Car", "Cyclist", "Pedestrian"))
    points = read(split, CONFIG).points
    inside = points_in_boxes(points, read(split, CONFIG).boxes)
    cyclist = points[inside[:, 1]]
    assert len(cyclist) > 10
    outside = points[~inside.any(axis=1)]
    write_scan(split.scan_path("000000"), np.concatenate([outside, points[inside[:, 0]], cyclist[:7]]))
    for min_points, expected in (
        (0, [0, 2, 1]),
        (1, [0, 2, IGNORED]),
        (7, [0, 2, IGNORED]),
        (8, [0, IGNORED, IGNORED]),
    ):
        frame = read(split, with_data(min_points=min_points))
        assert frame.labels.tolist() == expected, f"min_points {min_points}"
        assert len(frame.boxes) == len(boxes)


def test_points_that_the_camera_does_not_see_are_left_out(tmp_path: Path) -> None:
    split, boxes = one_frame(tmp_path, ("Car",))
    # A camera of KITTI's sees some 40 degrees to each side, and from 2.7 degrees above to 15 below its axis.
    seen = [[20.0, 0.0, -1.0, 0.5], [20.0, 10.0, -1.0, 0.5], [20.0, -10.0, -1.0, 0.5]]
    unseen = [[-20.0, 0.0, -1.0, 0.5], [2.0, 15.0, -1.0, 0.5], [2.0, -15.0, -1.0, 0.5], [10.0, 0.0, 8.0, 0.5]]
    cloud = np.array([*seen, *unseen], np.float32)
    write_scan(split.scan_path("000000"), cloud)
    cropped = read(split, CONFIG).points
    assert np.array_equal(cropped, cloud[:3])
    assert np.array_equal(cropped, cloud[in_image(cloud, CALIBRATION)])
    assert np.array_equal(read(split, with_data(camera_view=False)).points, cloud)
    # An object whose points are all outside the image cannot be learnt from the others.
    boxes[:, 0] *= -1
    write_scan(split.scan_path("000000"), np.array([[*boxes[0, :3], 0.5]], np.float32))
    write_labels(split.label_path("000000"), objects_from_boxes(boxes, ("Car",), CALIBRATION))
    assert read(split, CONFIG).labels.tolist() == [IGNORED]
    assert read(split, with_data(camera_view=False)).labels.tolist() == [0]


def test_a_frame_without_points_or_labels(tmp_path: Path) -> None:
    split, _ = one_frame(tmp_path, ())
    frame = read(split, CONFIG)
    assert frame.boxes.shape == (0, 7) and frame.labels.shape == (0,) and len(frame.points) > 0
    one_frame(tmp_path, ("Car", "Pedestrian"))
    write_scan(split.scan_path("000000"), np.array([[-9, 0, 0, 0.5]], np.float32))  # behind the camera
    sample = open_dataset(tmp_path, with_data(train_set="val"), training=True).sample(0, 0)
    assert len(sample.prepared.pillars.cells) == len(sample.prepared.targets.positives) == 0
    frame = read(split, CONFIG)
    assert frame.points.shape == (0, 4) and frame.labels.tolist() == [IGNORED, IGNORED]


def test_lists_and_modes_and_validation_is_not_augmented(tmp_path: Path) -> None:
    root = write_dataset(tmp_path, 5, val_frames=2)
    training, validation = (open_dataset(root, CONFIG, training=training) for training in (True, False))
    assert training.frame_ids == ("000000", "000001", "000002") and len(training) == 3
    assert validation.frame_ids == ("000003", "000004") and len(validation) == 2
    write_image_set(root, "few", ["000001"])
    assert open_dataset(root, with_data(train_set="few"), training=True).frame_ids == ("000001",)
    plain = read(validation.frames.split, CONFIG, "000004")
    for epoch in (0, 5):
        sample = validation.sample(epoch, 1)
        assert np.array_equal(sample.frame.points, plain.points) and np.array_equal(sample.frame.boxes, plain.boxes)
        assert np.array_equal(sample.prepared.pillars.features, SPEC.pillarize(plain.points).features)


def test_training_samples_change_with_seed_and_epoch_together_with_their_targets(tmp_path: Path) -> None:
    root = write_dataset(tmp_path, 3)
    frames = open_dataset(root, CONFIG, training=True)
    reseeded = dataclasses.replace(CONFIG, train=dataclasses.replace(CONFIG.train, seed=1))
    other_seed = open_dataset(root, reseeded, training=True)
    samples = [frames.sample(0, 0), frames.sample(1, 0), other_seed.sample(0, 0)]
    boxes = [sample.frame.boxes for sample in samples]
    assert not any(np.array_equal(boxes[i], boxes[j]) for i, j in ((0, 1), (0, 2), (1, 2)))
    for sample in samples:
        expected = assign_targets(SPEC.anchors, SPEC.classes, sample.frame.boxes, sample.frame.labels)
        for found, wanted in zip(vars(sample.prepared.targets).values(), vars(expected).values(), strict=True):
            assert np.array_equal(found, wanted)
        inside = SPEC.grid.cells(sample.frame.points) >= 0
        assert sample.prepared.pillars.stats.points == len(sample.frame.points)
        assert sample.prepared.pillars.stats.points_outside == (~inside).sum()


def test_the_assigner_of_the_configuration_makes_the_targets(tmp_path: Path) -> None:
    model = PillarModel(spec=SPEC, loss=LossConfig(assigner="atss"))
    frames = open_dataset(write_dataset(tmp_path, 3), dataclasses.replace(CONFIG, model=model), training=True)
    sample = frames.sample(0, 0)
    labelled = (SPEC.anchors, SPEC.classes, sample.frame.boxes, sample.frame.labels)
    assert np.array_equal(sample.prepared.targets.state, assign_targets(*labelled, "atss").state)
    assert not np.array_equal(sample.prepared.targets.state, assign_targets(*labelled, "overlap").state)
    assert frames.preparation == build_pillar_detector(model).preparation


def samples(root: Path) -> list[Sample]:
    """Three frames of different size; the one in the middle has no points and nothing to find."""
    frames = open_dataset(write_dataset(root, 3, val_frames=2), CONFIG, training=False)
    no_points, no_boxes = np.empty((0, 4), np.float32), np.empty((0, 7), np.float32)
    empty = LabeledFrame("none", no_points, no_boxes, np.empty(0, np.int64))
    nothing = assign_targets(SPEC.anchors, SPEC.classes, empty.boxes, empty.labels)
    return [
        frames.sample(0, 0),
        Sample(empty, TargetedPillars(SPEC.pillarize(empty.points), Placement(None, None), nothing)),
        frames.sample(0, 1),
    ]


@pytest.mark.parametrize("order", [(1, 0, 2), (0, 2, 1), (1,)])
def test_batches_keep_frames_apart(tmp_path: Path, order: tuple[int, ...]) -> None:
    all_samples = samples(tmp_path)
    chosen = [all_samples[i] for i in order]
    batch = Collate(PillarPreparation(SPEC))(chosen)
    assert isinstance(batch, Batch) and isinstance(batch.inputs, LabeledPillars)
    pillar_batch, target_batch = batch.inputs
    assert batch.frame_ids == [sample.frame.frame_id for sample in chosen]
    assert all(boxes is sample.frame.boxes for boxes, sample in zip(batch.boxes, chosen, strict=True))
    assert all(labels is sample.frame.labels for labels, sample in zip(batch.labels, chosen, strict=True))

    features, pillar_index, point_counts, cells, frame_pillars, *_ = pillar_batch
    assert list(frame_pillars) == [len(sample.prepared.pillars.cells) for sample in chosen]
    first_pillar = first_point = first_positive = 0
    for i, sample in enumerate(chosen):
        pillars, targets = sample.prepared.pillars, sample.prepared.targets
        own_pillars = slice(first_pillar, first_pillar + len(pillars.cells))
        own_points = slice(first_point, first_point + len(pillars.features))
        assert np.array_equal(features[own_points], pillars.features)
        assert np.array_equal(pillar_index[own_points].numpy() - first_pillar, pillars.pillar_index)
        assert np.array_equal(point_counts[own_pillars], pillars.point_counts)
        assert np.array_equal(cells[own_pillars], pillars.cells)
        first_pillar, first_point = own_pillars.stop, own_points.stop

        own_positives = slice(first_positive, first_positive + len(targets.positives))
        assert np.array_equal(target_batch.state[i], targets.state)
        assert np.array_equal(target_batch.anchors[own_positives], targets.anchors)
        assert np.array_equal(target_batch.residuals[own_positives], targets.residuals)
        assert np.array_equal(target_batch.directions[own_positives], targets.directions)
        first_positive = own_positives.stop
    assert (len(cells), len(features), len(target_batch.positives)) == (first_pillar, first_point, first_positive)
    # Counted through (B, H, W, A) they are exactly the positives of the stacked states.
    assert np.array_equal(target_batch.positives, np.flatnonzero(target_batch.state.numpy() == 1))
    # Points and pillars agree: each pillar is pointed at as often as it says.
    assert np.array_equal(np.bincount(pillar_index, minlength=len(cells)), point_counts)
    types = [tensor.dtype for tensor in (features, pillar_index, cells, target_batch.state, target_batch.positives)]
    assert types == [torch.float32, torch.int64, torch.int64, torch.int8, torch.int64]


def test_a_batch_is_pinned_as_a_whole(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(torch.Tensor, "pin_memory", lambda tensor: tensor.to("meta"))  # a CPU alone has none
    frames = open_dataset(write_dataset(tmp_path, 3), CONFIG, training=True)
    batch = Collate(frames.preparation)([frames.sample(0, 0)])
    assert isinstance(batch, Batch) and batch.pin_memory() is batch
    assert {each.device.type for each in tree_leaves(batch.inputs) if isinstance(each, torch.Tensor)} == {"meta"}


def test_a_batch_moves_as_a_whole_with_the_tables_of_a_sparse_neck(tmp_path: Path) -> None:
    model = PillarModel(spec=SPEC, network=NetworkConfig(neck="sparse"))
    frames = open_dataset(write_dataset(tmp_path, 3), dataclasses.replace(CONFIG, model=model), training=True)
    batch = Collate(frames.preparation)([frames.sample(0, 0), frames.sample(0, 1)])
    assert isinstance(batch, Batch) and isinstance(batch.inputs, LabeledPillars)
    neck = batch.inputs.pillars.neck
    assert neck is not None and sum(neck.frame_rows) == len(neck.head_cells)
    assert len(neck.levels[0].strided_back) == len(batch.inputs.pillars.cells)
    frame_pillars = list(batch.inputs.pillars.frame_pillars)
    assert batch.to("meta") is batch and isinstance(batch.boxes[0], np.ndarray)
    moved = batch.inputs.pillars
    assert moved.neck is not None and moved.neck.frame_rows == neck.frame_rows
    assert list(moved.frame_pillars) == frame_pillars
    devices = {each.device.type for each in tree_leaves(batch.inputs) if isinstance(each, torch.Tensor)}
    assert devices == {"meta"}


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (lambda split: split.calib_path("000000").unlink(), r"calib/000000\.txt: "),
        (lambda split: split.label_path("000000").unlink(), r"label_2/000000\.txt: .*needs an empty file"),
        (lambda split: split.label_path("000000").write_text("Car 1 2\n"), r"label_2/000000\.txt:1: 3 fields"),
        (
            lambda split: split.label_path("000000").write_text("Car 0 0 0 1 1 9 9 -1 -1 -1 -1000 -1000 -1000 -10\n"),
            r"label_2/000000\.txt: a Car has no 3D box.*DontCare",
        ),
        (lambda split: split.scan_path("000000").unlink(), r"velodyne/000000\.bin: listed in ImageSets/train\.txt"),
        (lambda split: (Path(split.root) / "ImageSets/train.txt").unlink(), r"ImageSets/train\.txt: no such split"),
    ],
)
def test_what_is_missing_or_damaged_is_named(
    tmp_path: Path, damage: Callable[[KittiSplit], object], message: str
) -> None:
    root = write_dataset(tmp_path, 3)
    damage(KittiSplit(root))
    with pytest.raises(DatasetError, match=message) as caught:
        _ = open_dataset(root, CONFIG, training=True).sample(0, 0)
    assert "\n" not in str(caught.value) and str(tmp_path) in str(caught.value)
