"""NumPy's BLAS threads sleep from the points to the boxes and in training's loaders.

After a matrix product they spin for tens of milliseconds. With a sensor's height given, that took the cores from the
network: neck and head took up to twice as long.
"""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

SCHEDSTAT = Path("/proc/self/schedstat")

PROBE = """
import json, os, sys, time

before = set(os.listdir("/proc/self/task"))
import numpy as np
blas = set(os.listdir("/proc/self/task")) - before  # OpenBLAS starts its threads when it is loaded

def worked_ms():
    return sum(int(open(f"/proc/self/task/{thread}/schedstat").read().split()[0]) for thread in blas) / 1e6

steps = {}

def step(name, work):
    start = worked_ms()
    work()
    steps[name] = worked_ms() - start

square = np.ones((700, 700), np.float32)
step("a matrix product", lambda: square @ square)
last = -1.0
while last != worked_ms():  # until they sleep
    last = worked_ms()
    time.sleep(0.3)
"""

STEPS = """
from pathlib import Path
from asca_deploy.tracker import Tracker
from asca_pillars import Detector, Mounting, read_scan
from asca_deploy import sample_scan_path
from tests.helpers.bundles import DENSE_INT8, PV_RCNN
from asca_pillars.scans.ground_height import estimate_height

points = read_scan(sample_scan_path()).points
cos, sin = np.cos(0.05), np.sin(0.05)
pose = ((cos, 0, sin, 0), (0, 1, 0, 0.1), (-sin, 0, cos, 0), (0, 0, 0, 1))
for bundle, name, options in (
    ("default", "plain", {}),
    ("default", "height", {"mounting": Mounting(sensor_height_m=1.9)}),
    ("default", "pose", {"mounting": Mounting(pose=pose)}),
    ("default", "around", {"view": "around"}),
    ("accurate", "height", {"mounting": Mounting(sensor_height_m=1.9)}),
    (DENSE_INT8, "height", {"mounting": Mounting(sensor_height_m=1.9)}),
):
    detector = Detector(bundle, **options)
    step(f"{Path(bundle).name} {name}", lambda: detector(points))
step("stream", lambda: list(Detector(mounting=Mounting(axes="y-forward")).stream([points, points])))
step("pv_rcnn", lambda: Detector(PV_RCNN, mounting=Mounting(sensor_height_m=1.9))(points))
step("sensor height", lambda: estimate_height([points], Mounting(pose=pose)))
found = Detector()(points)
step("tracker", lambda: [Tracker()(found, 0.1 * scan, np.array(pose)) for scan in range(3)])

# In training's loaders
from asca_pillars.config.tree import AugmentConfig
from asca_pillars.data.augment import augment
from asca_pillars.data.frames import LabeledFrame
from asca_pillars.data.insertion.insert_objects import rays_entering
from asca_pillars.data.insertion.free_space import find_free_space
from asca_pillars.data.kitti.calibration import in_image
from asca_pillars.geometry.frame_change import FrameChange
from tests.helpers.scenes import CALIBRATION

frame = LabeledFrame("0", points, found.boxes, found.labels)
config = AugmentConfig(object_cut_probability=1.0, object_jitter_m=0.02, shift_z_m=0.2)
step("camera's view", lambda: in_image(points, CALIBRATION))
step("scan settings", lambda: FrameChange.turn(0.1).points(points))
for seed in range(3):
    step(f"augmentation {seed}", lambda: augment(frame, config, np.random.default_rng(seed)))
step("free ground", lambda: find_free_space(points))
step("insertion", lambda: rays_entering(points, found.boxes))
"""


@pytest.mark.skipif(not SCHEDSTAT.exists(), reason="needs Linux, whose kernel tells the time that a thread has worked")
def test_blas_threads_sleep() -> None:
    code = PROBE + STEPS + "print(json.dumps(steps))"
    environment = os.environ | {"OPENBLAS_NUM_THREADS": "2"}
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, env=environment, timeout=300)
    assert result.returncode == 0, result.stderr
    worked_ms = json.loads(result.stdout)
    if worked_ms.pop("a matrix product") < 0.1:
        pytest.skip("NumPy's matrix products use no threads of their own here")
    assert len(worked_ms) > 12
    assert {name: spent for name, spent in worked_ms.items() if spent > 0} == {}
