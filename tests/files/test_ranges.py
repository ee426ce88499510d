"""Numbers that no vehicle can have are refused by file and key, in every format."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pydantic import BaseModel

from jaxnav.drive.interfaces import Odometry
from jaxnav.drive.pilot import Input
from jaxnav.drive.stamps import MOST_NS, Stamps
from jaxnav.errors import BadInput
from jaxnav.files.ranges import RANGES, is_within, pinhole_problem, problem_of
from jaxnav.files.reading import read_mapping
from jaxnav.files.validation import validate
from jaxnav.recordings.drive_format import decode, encode
from jaxnav.recordings.drive_setup import DriveSetup
from jaxnav.recordings.records import MESSAGES, input_message
from tests.helpers.loader_seeds import STRUCTURED
from tests.helpers.simulated import make_setup
from tests.helpers.yaml_numbers import dumped

PAGE = Path(__file__).resolve().parents[2] / "docs" / "ranges.md"
ODD = [1e9, 1e-6, 1e300]
# Loader of `loader_seeds`, the way to a number, and odd numbers for it.
FIELDS: list[tuple[str, tuple[Any, ...], list[float]]] = [
    ("rig", ("cameras", 0, "focal_px", 0), ODD),
    ("rig", ("cameras", 0, "center_px", 1), [1e9, -1e9, 1e300]),
    ("rig", ("cameras", 0, "distortion", 0), [1e9, -1e300]),
    ("rig", ("cameras", 0, "position_m", 2), [1e9, -1e5]),
    ("rig", ("cameras", 0, "yaw_deg"), [1e9]),
    ("saved rig", ("cameras", 0, "exposure_s"), [1.0, 1e-9]),
    ("saved rig", ("cameras", 0, "row_time_s"), [0.1, -1e-6]),
    ("saved rig", ("cameras", 0, "T_camera_vehicle", "xyz_m", 0), [1e9, 1e5]),
    ("saved markers", ("markers", 0, "size_m"), ODD),
    ("saved markers", ("markers", 0, "T_world_marker", "xyz_m", 1), [1e9, -1e300]),
    *(("vehicle", (name,), [1e9, 1e-9]) for name in (
        "wheelbase_m", "steering_limit_rad", "throttle_limit", "speed_per_throttle_mps",
        "speed_time_constant_s")),
    ("route", ("waypoints_m", 0, 0), [1e9]),
    ("route", ("waypoint_radius_m",), ODD),
    ("route", ("start", "psi_deg"), [1e9]),
    ("topics", ("corner_sigma_px",), ODD),
    ("topics with an IMU", ("imu", "gyroscope_noise_density"), [1e9, 1e300]),
    ("topics with an IMU", ("imu", "max_accel_mps2"), [1e-6, 1e300]),
    ("topics with an IMU", ("imu", "imu_delay_s"), [1.0, 1e300]),
    ("topics with an IMU", ("imu", "T_vehicle_imu", "xyz_m", 0), [1e9, 1e5]),
    ("Kalibr rig", ("cam0", "intrinsics", 0), ODD),
    ("Kalibr rig", ("cam0", "intrinsics", 2), [1e9, 1e300]),
    ("Kalibr rig", ("cam0", "distortion_coeffs", 0), [1e9]),
    ("Kalibr rig", ("cam0", "T_cam_imu", 0, 3), [1e9, 1e5]),
    ("camera_info", ("camera_matrix", "data", 0), ODD),
    ("camera_info", ("camera_matrix", "data", 2), [1e9]),
    ("camera_info", ("distortion_coefficients", "data", 0), [1e8]),
    ("OpenCV", ("camera_matrix", "data", 4), ODD),
    ("PhotonVision", ("cameraIntrinsics", "data", 5), [1e9]),
    ("WPILib", ("tags", 0, "pose", "translation", "x"), [1e9]),
    ("TagSLAM cameras.yaml", ("cam0", "intrinsics", 0), ODD),
    ("TagSLAM tagslam.yaml", ("bodies", 0, "wall", "default_tag_size"), ODD),
    ("TagSLAM camera_poses.yaml", ("cam0", "pose", "position", "x"), [1e9]),
]  # fmt: skip


def put(data: Any, keys: tuple[Any, ...], value: Any) -> None:
    for key in keys[:-1]:
        data = data[key]
    assert data[keys[-1]] != value
    data[keys[-1]] = value


@pytest.mark.parametrize(("name", "keys", "odd"), FIELDS, ids=lambda part: str(part)[:60])
def test_an_odd_number_is_refused_by_file_and_key(name, keys, odd, tmp_path):
    loader = STRUCTURED[name]
    path = loader.make(tmp_path)
    loader.load(path)
    for value in odd:
        data = read_mapping(path)
        put(data, keys, value)
        sound = path.read_bytes()
        path.write_text(json.dumps(data) if path.suffix == ".json" else dumped(data))
        with pytest.raises(BadInput) as caught:
            loader.load(path)
        path.write_bytes(sound)
        line = str(caught.value)
        assert path.name in line
        named = [key for key in keys if isinstance(key, str)]
        assert any(key in line for key in named[-2:]), line


@pytest.mark.parametrize(
    ("keys", "odd"),
    [
        (("rig", "cameras", 0, "focal_px", 0), ODD),
        (("rig", "cameras", 0, "center_px", 0), [1e300]),
        (("markers", "markers", 0, "size_m"), ODD),
        (("vehicle", "wheelbase_m"), ODD),
        (("route", "start_pose", 0), [1e9]),
        (("route", "start_pose", 2), [1e6]),
        (("route", "waypoint_radius_m"), ODD),
        (("corner_sigma_px",), ODD),
    ],
)
def test_so_it_is_in_the_header_of_a_drive(keys, odd):
    for value in odd:
        header = decode(encode(make_setup().header()))
        put(header, keys, value)
        named = keys[-1] if len(keys) < 3 and isinstance(keys[-1], str) else keys[0]
        with pytest.raises(BadInput, match=rf"drive.mcap: header.*{named}"):
            DriveSetup.from_header(header, Path("drive.mcap"))


def test_the_page_for_users_shows_the_table():
    """If it fails, put what it expects into docs/ranges.md."""
    lines = ["| quantity | from | to | unit | outside of it |", "|---|---|---|---|---|"]
    for allowed in RANGES.values():
        bounds = f"{_number(allowed.least)} | {_number(allowed.most)}"
        lines.append(f"| {allowed.what} | {bounds} | {allowed.unit} | {allowed.outside} |")
    assert "\n".join(lines) + "\n" in PAGE.read_text()


def _number(value: float) -> str:
    for power in (62, 63):
        for sign, off in ((1, -1), (-1, 1), (-1, 0)):
            if value == sign * 2**power + off and isinstance(value, int):
                return f"{'-' if sign < 0 else ''}2^{power}{f' {off:+d}' if off else ''}"
    return f"{value:.10g}"


def test_bounds_are_in_and_what_is_beyond_is_not():
    for name, allowed in RANGES.items():
        step = 1 if isinstance(allowed.least, int) else 1e-5 * max(abs(allowed.most), 1e-3)
        for value in (allowed.least, allowed.most):
            assert problem_of(name, value) is None, name
        for value in (allowed.least - step, allowed.most + step, np.nan):
            if np.isfinite(allowed.most):
                assert problem_of(name, value) is not None, name
                assert not is_within(name, np.array([float(value)])) or isinstance(step, int), name


def test_focal_length_and_principal_point_are_held_against_the_image():
    assert pinhole_problem([319, 319, 401, 202], [820, 410]) is None
    assert pinhole_problem([3.6, 3.6, 401, 202], [820, 410]) is None  # mm: the doctor tells
    assert "fx" in str(pinhole_problem([0.1, 319, 401, 202], [820, 410]))
    assert "cy" in str(pinhole_problem([319, 319, 401, 2000], [820, 410]))


def test_a_stamp_that_no_clock_can_say_is_recorded_as_one_that_nobody_believes():
    for stamp_ns in (2**70, 2**62, -(2**70), MOST_NS):
        given = Input(5, Odometry(stamp_ns, 0.0, 0.0))
        topic, _, message = input_message(given)
        model: type[BaseModel] = MESSAGES[topic][1]
        back = validate(model, decode(encode(message)), Path("a.mcap")).input()
        assert abs(back.odometry.stamp_ns) == MOST_NS
        live, again = Stamps(), Stamps()
        for now_ns in range(10**9, 2 * 10**9, 10**7):
            told = live.take(stamp_ns + now_ns * (stamp_ns > 0), now_ns)
            assert told is again.take(back.odometry.stamp_ns, now_ns) is None
        assert live == again


def test_a_recorded_stamp_beyond_the_table_is_refused():
    _, _, message = input_message(Input(5, Odometry(7, 0.0, 0.0)))
    for key in ("stamp_ns", "now_ns"):
        data = decode(encode(message)) | {key: 2**62}
        with pytest.raises(BadInput, match=rf"a\.mcap: {key}: must be <"):
            validate(MESSAGES["/odometry"][1], data, Path("a.mcap"))
