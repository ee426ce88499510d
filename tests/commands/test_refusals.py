"""What a command refuses before it begins is one line that names the file and key, or the flag."""

import shlex
from pathlib import Path

import cv2
import numpy as np
import pytest

from jaxnav.files import calib_dir, write_params

QCAR = calib_dir() / "qcar"
CAMERA = f"--camera {QCAR}/rig.yaml --camera-name front --marker-size-m 0.172"
CAR = "stop --car tests.helpers.plain_car:"
BASE = "base: differential\nforward_limit_mps: 1\nturn_limit_radps: fast\ntime_constant_s: 0.15\n"
FILES = {
    "car.yaml": (QCAR / "vehicle.yaml").read_text().replace("m: 0.256", "m: -1"),
    "bad.yaml": "wheelbase_m: 0.3\n",
    "odd.yaml": BASE,
    "text.png": "not an image",
    "empty.png": "",
    "zero.yaml": "cam0: {camera_model: pinhole, intrinsics: [0, 1, 2, 3], distortion_model: none,"
    " distortion_coeffs: [], resolution: [64, 48]}\n",
}
REFUSED = {
    f"demo --markers {QCAR}/rig.yaml": "rig.yaml",
    "demo --vehicle car.yaml": "car.yaml: wheelbase_m",
    "demo --params params.yaml": "parameters.motion.vision_floor: must have 3 entries",
    "demo --exposure-ms 60": "--exposure-ms: the last row would be read after",
    "demo --out car.yaml": "is a file, not a folder",
    "simulate --corner-noise-px -1": "--corner-noise-px",
    "simulate --resume": "--resume",
    "simulate --laps 101": "--laps",
    "simulate --laps 1 --route r.yaml": "--laps: takes the place of --route",
    "simulate --laps 1 --scenario static": "--laps: nothing drives in static",
    "simulate --base omni --vehicle v.yaml": "--base: omni takes the place of",
    "simulate --scenario gyro-late": "--scenario: gyro-late turns on the spot",
    "reliability nowhere.bag": "nowhere.bag",
    "faults --only earthquake": "--only: names no fault",
    "tune filter --seed -1": "--seed: must be at least 0",
    "tune filter --part 0.5 0.5": "--part: must be two parts",
    "tune filter --corner-noise-px nan": "--corner-noise-px: must be from 0.001 to 100 px",
    "tune filter drive.mcap --imu consumer": "--imu: is of simulated drives",
    "tune filter drive.mcap --route r.yaml": "--route: is of simulated drives",
    "tune controller --base omni --vehicle v.yaml": "--base: omni takes the place",
    "tune controller --learning-rate inf": "--learning-rate: must be finite",
    "tune controller --test-scenario static": "--scenario: nothing drives in static",
    "tune controller --train controller.fame": "--train: there is no controller.fame",
    "tune controller --time=0 --cross-track=0 --effort=0 --smoothness=0": "nothing to lower",
    f"locate missing.png {CAMERA}": "missing.png: can't be read: no such file",
    f"locate text.png {CAMERA}": "text.png: is not an image",
    f"locate empty.png {CAMERA}": "empty.png: is not an image",
    f"locate small.png {CAMERA}": "is 64 x 48 pixels, but --camera",
    f"locate small.png --camera {QCAR}/rig.yaml --marker-size-m 0": "--marker-size-m: must be from",
    f"locate small.png --camera {QCAR}/rig.yaml --marker-size-m 0.1": "front",
    f"locate small.png {CAMERA} --family tag99h1": "tag99h1",
    "locate small.png --camera zero.yaml --marker-size-m 0.1": "intrinsics",
    f"locate small.png {CAMERA} --out a.pdf": "--out: must end in .png or .jpg",
    "stop --car nobody": "--car: there is no 'nobody'",
    "stop --car sim": "--car: sim ends with its drive: nothing is left to stop",
    f"{CAR}open_curious_vehicle --option log=x": "vehicle: can't be opened by itself: it looks",
    f"{CAR}open_vehicle --vehicle bad.yaml": "bad.yaml: steering_limit_rad: missing",
    f"{CAR}open_vehicle --vehicle odd.yaml": "turn_limit_radps: must be a finite number, got",
    "calibrate odometry nowhere.mcap": "nowhere.mcap: there is no such recording",
    "calibrate odometry .": "is no recording of jaxnav (.mcap): a ROS bag needs --topics",
    "calibrate odometry a.mcap --wheelbase-sigma-m 0": "--wheelbase-sigma-m: must be from 0.001",
    "calibrate odometry a.mcap --fix wheelbase_m --wheelbase-sigma-m 0.001": "leave it out of",
    "doctor --frame front": "jaxnav doctor: --frame: expected CAMERA=IMAGE, got 'front'",
    "doctor --option speed": "jaxnav doctor: --option: expected KEY=VALUE, got 'speed'",
    "doctor --speed": "jaxnav doctor: Unrecognized options: --speed",
}


@pytest.mark.parametrize("typed", REFUSED)
def test_what_is_refused_is_one_line(typed, refusal, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for name, text in FILES.items():
        Path(name).write_text(text)
    write_params("params.yaml", {"motion.vision_floor": [1] * 6})
    cv2.imwrite("small.png", np.zeros((48, 64), np.uint8))
    before = sorted(Path().iterdir())
    assert REFUSED[typed] in refusal(*shlex.split(typed))
    assert sorted(Path().iterdir()) == before
