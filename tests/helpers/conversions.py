"""What the tests of `jaxnav calibrate convert` share: the tools' own files, and cameras."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import strategies as st

from jaxnav import files
from jaxnav.commands.calibrate import convert as calibrate_convert
from jaxnav.commands.calibrate.arguments import CalibrateConvert
from jaxnav.core.models.lenses import LENSES
from jaxnav.errors import BadInput
from jaxnav.files import poses
from jaxnav.files.cameras import camera_file
from jaxnav.files.kalibr import names_by_topic
from jaxnav.files.markers import MarkerEntry, MarkerFile
from jaxnav.files.reading import read_mapping
from jaxnav.files.rigs import CameraEntry, pose_entry

QCAR = files.calib_dir() / "qcar"


def convert(source: Path, to: str, out: Path, **flags: Any) -> Path:
    assert calibrate_convert.run(CalibrateConvert(source, to, out, **flags)) == 0
    return out


def problem(source: Path, to: str, out: Path, **flags: Any) -> str:
    before = sorted(out.parent.rglob("*"))
    with pytest.raises(BadInput) as caught:
        convert(source, to, out, **flags)
    line = str(caught.value)
    assert "\n" not in line
    assert sorted(out.parent.rglob("*")) == before
    return line


def cameras_in(path: Path) -> tuple[CameraEntry, ...]:
    return camera_file(path, read_mapping(path), names_by_topic).cameras


def markers_in(path: Path) -> list[MarkerEntry]:
    return [entry.placed() for entry in MarkerFile.model_validate(read_mapping(path)).markers]


def same_lens(a: CameraEntry, b: CameraEntry) -> bool:
    """All but the place, bit for bit."""
    keys = ("name", "lens", "focal_px", "center_px", "distortion", "image_size_px")
    return all(getattr(a, key) == getattr(b, key) for key in keys)


def written(folder: Path, name: str, text: str) -> Path:
    (folder / name).write_text(text)
    return folder / name


MATRIX_LENSES = ("radtan", "rational", "thin_prism", "equidistant")
# What holds which lens, of the formats with one camera a file.
HELD = [
    *((to, lens) for to in ("ros", "opencv") for lens in MATRIX_LENSES),
    ("photonvision", "radtan"),
    ("photonvision", "rational"),
]


def numbers(least: float, most: float) -> st.SearchStrategy[float]:
    return st.floats(least, most).filter(lambda value: value == 0 or abs(value) > 1e-300)


@st.composite
def a_camera(draw, lens: str, name: str = "front", k3: bool = True) -> CameraEntry:
    within = LENSES[lens].within
    bounds = [within.get(key, (-10.0, 10.0)) for key in LENSES[lens].coefficients]
    coefficients = [draw(st.floats(least, min(most, 10.0))) for least, most in bounds]
    if lens == "radtan" and not k3:
        coefficients[4] = 0.0
    if lens == "rational" and not any(coefficients[5:]):
        coefficients[5] = 0.5  # or it is radtan
    if lens == "thin_prism" and not any(coefficients[8:]):
        coefficients[8] = 0.5  # or it is rational
    q = np.array([draw(st.floats(-1, 1)) for _ in range(4)])
    q = q / np.linalg.norm(q) if np.linalg.norm(q) > 0.1 else np.array([1.0, 0, 0, 0])
    T = np.array([*q, *(draw(numbers(-500, 500)) for _ in range(3))])
    width, height = draw(st.integers(1, 65536)), draw(st.integers(1, 65536))
    focal = st.floats(*(bound * max(width, height) for bound in (1e-3, 1e3)))
    return CameraEntry.create(
        name,
        lens,
        [draw(focal), draw(focal), *(draw(numbers(-n, 2 * n)) for n in (width, height))],
        coefficients,
        (width, height),
        T_camera_vehicle=pose_entry(T) if draw(st.booleans()) else poses.matrix(T).tolist(),
    )


# kalibr_calibrate_imu_camera: keys in the order of the alphabet, whole numbers where they are.
KALIBR = """cam0:
  T_cam_imu:
  - [0.014865542981794, 0.999557249008346, -0.025774436697440, 0.065222909535531]
  - [-0.999880929698575, 0.014967213324719, 0.003756188357967, -0.020706385492719]
  - [0.004140296794224, 0.025715529947966, 0.999660727177902, -0.008054602460030]
  - [0.0, 0.0, 0.0, 1.0]
  cam_overlaps: [1]
  camera_model: pinhole
  distortion_coeffs: [-0.28340811, 0.07395907, 0.00019359, 1.76187114e-05]
  distortion_model: radtan
  intrinsics: [458, 457.296, 367.215, 248.375]
  resolution: [752, 480]
  rostopic: /left/image_raw
  timeshift_cam_imu: 0.00012
cam1:
  T_cam_imu:
  - [0, -1, 0, 1]
  - [1, 0, 0, -2]
  - [0, 0, 1, 0]
  - [0, 0, 0, 1]
  T_cn_cnm1:
  - [0.9999806, 0.0023, 0.0058, -0.110074]
  - [-0.0023, 0.999898, 0.0141, 0.00039]
  - [-0.0057, -0.0141, 0.99988, -0.00085]
  - [0.0, 0.0, 0.0, 1.0]
  cam_overlaps: [0]
  camera_model: pinhole
  distortion_coeffs: [-0.0149, 0, 1.5e-2, -7.0e-3]
  distortion_model: equidistant
  intrinsics: [457.587, 456.134, 379.999, 255]
  resolution: [752, 480]
  rostopic: /cam1
  timeshift_cam_imu: 0.00013
"""

# camera_calibration of ROS, with the halves of a stereo pair rectified and long lists broken.
ROS = """image_width: 640
image_height: 480
camera_name: 00b09d0100990bb2
camera_matrix:
  rows: 3
  cols: 3
  data: [438.783367, 0.000000, 305.593336, 0.000000, 437.302876, 243.738352,
    0.000000, 0.000000, 1.000000]
distortion_model: rational_polynomial
distortion_coefficients:
  rows: 1
  cols: 8
  data: [-0.361976, 0.110510, 0.001014, 0.000505, 0.000000, 0.000000,
    0.000000, 0.000000]
rectification_matrix:
  rows: 3
  cols: 3
  data: [0.999978, 0.002789, -0.006046, -0.002816, 0.999986, -0.004401,
    0.006034, 0.004417, 0.999972]
projection_matrix:
  rows: 3
  cols: 4
  data: [393.653800, 0.000000, 322.797939, 0.000000, 0.000000, 393.653800,
    241.090902, 0.000000, 0.000000, 0.000000, 1.000000, 0.000000]
"""

# A calibration page's export; a snapshot is megabytes of base64.
PHOTONVISION = {
    "resolution": {"width": 1280.0, "height": 800.0},
    "cameraIntrinsics": {"rows": 3, "cols": 3, "type": 6,
                         "data": [907.5, 0.0, 645.2, 0.0, 908.25, 388.9, 0.0, 0.0, 1.0]},
    "distCoeffs": {"rows": 1, "cols": 8, "type": 6,
                   "data": [0.0489, -0.0762, 2.5e-4, -1.1e-4, 0.0176, 0.0, 0.0, 0.0]},
    "calobjectWarp": [1.2e-4, -3.0e-5],
    "observations": [{"locationInObjectSpace": [{"x": 0.0, "y": 0.0, "z": 0.0}],
                      "snapshotName": "img0.png",
                      "snapshotData": {"rows": 800, "cols": 1280, "type": 16, "data": "iVBOR"}}],
    "calobjectSize": {"width": 7.0, "height": 7.0},
    "calobjectSpacing": 0.0254,
    "lensmodel": "LENSMODEL_OPENCV",
}  # fmt: skip

# Numbers of WPILib's 2024-crescendo.json.
TAGS = {
    7: ((-0.038099999999999995, 5.547867999999999, 1.4511020000000001), (1.0, 0.0, 0.0, 0.0)),
    4: ((16.579342, 5.547867999999999, 1.4511020000000001), (6.123233995736766e-17, 0.0, 0.0, 1.0)),
    6: ((1.8415, 8.2042, 1.355852), (-0.7071067811865475, -0.0, 0.0, 0.7071067811865476)),
    1: ((15.079471999999997, 0.24587199999999998, 1.355852),
        (0.5000000000000001, 0.0, 0.0, 0.8660254037844386)),
}  # fmt: skip
LAYOUT = {
    "tags": [
        {
            "ID": marker_id,
            "pose": {
                "translation": dict(zip("xyz", xyz, strict=True)),
                "rotation": {"quaternion": dict(zip("WXYZ", wxyz, strict=True))},
            },
        }
        for marker_id, (xyz, wxyz) in TAGS.items()
    ],
    "field": {"length": 16.451, "width": 8.211},
}
