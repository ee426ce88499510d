"""Files in and out: valid files are read exactly, invalid ones give one line with file and key."""

import json
import os
from pathlib import Path
from typing import Any

import jax
import numpy as np
import pytest
import yaml

from jaxnav import files
from jaxnav.core.models.imu import GYROS
from jaxnav.core.models.rig import PLACED_BY_HAND
from jaxnav.core.models.vehicle import DEFAULT_TWIST_SIGMA, TwistBase
from jaxnav.files import poses
from jaxnav.files.rigs import CameraSigma
from tests.helpers import seed_texts
from tests.helpers.bad_input import problem

QCAR = files.calib_dir() / "qcar"


def leaves_equal(a: Any, b: Any) -> bool:
    leaves_a, leaves_b = (list(map(np.asarray, jax.tree.leaves(tree))) for tree in (a, b))
    return jax.tree.structure(a) == jax.tree.structure(b) and all(
        x.dtype == y.dtype and np.array_equal(x, y) for x, y in zip(leaves_a, leaves_b, strict=True)
    )


# --- what is shipped -----------------------------------------------------------------


def test_the_qcar_looks_in_four_directions_clockwise():
    rig = files.load_rig(QCAR / "rig.yaml")
    assert rig.names == ("front", "right", "rear", "left")
    assert rig.image_sizes_px == ((820, 410),) * 4
    assert rig.cameras.lenses == ("equidistant",)
    Ts_vehicle_camera = rig.Ts_camera_vehicle.inverse()
    R = np.asarray(Ts_vehicle_camera.rotation().as_matrix())
    optical_axes = [[1, 0, 0], [0, -1, 0], [-1, 0, 0], [0, 1, 0]]
    np.testing.assert_allclose(R[:, :, 2], optical_axes, atol=1e-12)
    np.testing.assert_allclose(R[:, :, 1], [[0, 0, -1]] * 4, atol=1e-12)  # y of the image is down
    np.testing.assert_allclose(
        Ts_vehicle_camera.translation(),
        np.c_[[0.193, 0.014, -0.165, 0.014], [0, -0.0674, 0, 0.0438], [0.0953] * 4],
        atol=1e-12,
    )


def test_the_paper_s_marker_faces_the_start():
    markers = files.load_markers(QCAR / "markers.yaml")
    assert (markers.ids, markers.families) == ((0,), ("tag36h11",))
    np.testing.assert_allclose(
        markers.corners_world_m[0],
        [[-0.086, 1.47, 0.312], [0.086, 1.47, 0.312], [0.086, 1.47, 0.14], [-0.086, 1.47, 0.14]],
        atol=1e-12,
    )
    R_world_marker = np.asarray(markers.Ts_world_marker.rotation().as_matrix())[0]
    np.testing.assert_allclose(R_world_marker[:, 2], [0, -1, 0], atol=1e-12)


def test_the_car_starts_towards_its_first_waypoint():
    vehicle = files.load_vehicle(QCAR / "vehicle.yaml")
    figures = vehicle.wheelbase_m, vehicle.steering_limit_rad, vehicle.throttle_limit
    assert [float(figure) for figure in figures] == [0.256, 0.5, 0.3]
    route = files.load_route(QCAR / "route.yaml")
    assert route.waypoints_m == ((1.30, 0.0), (0.50, 0.65))
    x, y, psi_rad = route.start_pose
    assert (x, y) == (2.0, -1.0)
    assert np.arctan2(0.0 - y, 1.30 - x) == pytest.approx(psi_rad, abs=1e-3)


def test_data_is_found_in_a_wheel_and_in_a_checkout(tmp_path, monkeypatch):
    package = tmp_path / "site-packages" / "jaxnav"
    monkeypatch.setattr(files, "__file__", str(package / "files" / "__init__.py"))
    assert "calib" in problem(files.calib_dir)
    (tmp_path / "site-packages" / "calib" / "qcar").mkdir(parents=True)
    assert files.calib_dir() == tmp_path / "site-packages" / "calib"
    (package / "calib" / "qcar").mkdir(parents=True)
    assert files.calib_dir() == package / "calib"


# --- there and back ------------------------------------------------------------------


def test_a_saved_rig_reads_back_bit_for_bit(precision, tmp_path):
    """With sigmas of places that are stated, left out, and exact."""
    text = yaml.safe_load((QCAR / "rig.yaml").read_text())
    stated = {"position_m": [0.001, 0.0023, 0.5], "rotation_deg": [0.1, 0.37, 15.0]}
    odd = {"position_m": [0.1, 0.2, 0.3], "yaw_deg": 33.3, "elevation_deg": -7.1, "roll_deg": 1.7}
    text["cameras"][0] |= {"sigma": stated}
    text["cameras"][1] |= odd | {"lens": "radtan", "distortion": [0.1, -0.02, 1e-3, 2e-4]}
    text["cameras"][2] |= {"lens": "none", "distortion": []} | sigma_of([0] * 3, [0] * 3)
    text["cameras"][3] |= {"exposure_s": 0.0123, "row_time_s": 0, "sigma": {"focal_px": [0.1] * 2}}
    rig = files.load_rig(write(tmp_path, text))
    assert rig.cameras.focal_px.dtype == rig.extrinsics_sigma.dtype == precision
    files.save_rig(tmp_path / "again.yaml", rig)
    again = files.load_rig(tmp_path / "again.yaml")
    assert leaves_equal(rig, again)
    assert (again.names, again.image_sizes_px) == (rig.names, rig.image_sizes_px)
    assert rig.timing(3) == again.timing(3) == (0.0123, 0.0)
    assert rig.timing(0) == again.timing(0) == rig.first(1).timing(0) == (None, None)
    sigma = np.asarray(again.extrinsics_sigma)
    np.testing.assert_allclose(sigma[0, :3], stated["position_m"], rtol=1e-7)
    np.testing.assert_allclose(np.rad2deg(sigma[0, 3:]), stated["rotation_deg"], rtol=1e-6)
    np.testing.assert_array_equal(sigma[2], 0)
    np.testing.assert_allclose(sigma[[1, 3]], [PLACED_BY_HAND] * 2, rtol=1e-7)


def test_cameras_are_placed_as_well_as_the_format_tells_or_are_exact(tmp_path):
    text = yaml.safe_load((QCAR / "rig.yaml").read_text())
    for camera in text["cameras"]:
        camera["sigma"] = {"position_m": [0] * 3, "rotation_deg": [0.0] * 3}
    exact = files.load_rig(write(tmp_path, text, "exact.yaml"))
    files.save_rig(tmp_path / "again.yaml", exact)
    for path, expected in (
        (QCAR / "rig.yaml", [[0.005] * 3 + [np.deg2rad(0.5)] * 3] * 4),
        (write(tmp_path, KALIBR), [[0.002] * 3 + [np.deg2rad(0.2)] * 3] * 2),
        (tmp_path / "exact.yaml", None),
        (tmp_path / "again.yaml", None),
    ):
        sigma = files.load_rig(path).extrinsics_sigma
        if expected is None:
            assert sigma is None
        else:
            np.testing.assert_allclose(sigma, expected, rtol=1e-7)


def test_a_calibration_s_sigmas_are_those_of_the_rig_it_saves(tmp_path):
    """In place of those that the rig came with."""
    rig = files.load_rig(QCAR / "rig.yaml")
    found = [
        CameraSigma(position_m=[0.001 * (1 + c)] * 3, rotation_deg=[0.1 * (1 + c)] * 3)
        for c in range(3)
    ]
    of_lens = CameraSigma(focal_px=[0.3, 0.4])
    files.save_rig(tmp_path / "rig.yaml", rig, sigmas=[*found, of_lens])
    sigma = np.asarray(files.load_rig(tmp_path / "rig.yaml").extrinsics_sigma)
    expected = [[0.001 * (1 + c)] * 3 + [np.deg2rad(0.1 * (1 + c))] * 3 for c in range(3)]
    np.testing.assert_allclose(sigma, [*expected, PLACED_BY_HAND], rtol=1e-6)
    written = yaml.safe_load((tmp_path / "rig.yaml").read_text())["cameras"][3]["sigma"]
    assert written["focal_px"] == [0.3, 0.4]


def test_a_saved_map_reads_back_bit_for_bit(precision, tmp_path):
    tilted = poses.rotation_towards(20.0, 30.0, 40.0)
    corners = (np.array([1.0, 2.0, 3.0]) + 0.1 * _SQUARE @ tilted.T).tolist()
    entry = {"id": 5, "family": "4x4_50", "size_m": 0.2, "corners_world_m": corners}
    entries = [entry, *yaml.safe_load((QCAR / "markers.yaml").read_text())["markers"]]
    (tmp_path / "markers.yaml").write_text(yaml.safe_dump({"markers": entries}))
    markers = files.load_markers(tmp_path / "markers.yaml")
    assert markers.size_m.dtype == precision
    np.testing.assert_allclose(markers.corners_world_m[0], corners, atol=1e-6)
    files.save_markers(tmp_path / "again.yaml", markers)
    again = files.load_markers(tmp_path / "again.yaml")
    assert leaves_equal(markers, again)
    assert (again.ids, again.families) == ((5, 0), ("4x4_50", "tag36h11"))


_SQUARE = np.array([[-1, 1, 0], [1, 1, 0], [1, -1, 0], [-1, -1, 0]], float)


def test_the_three_ways_to_place_a_camera_agree(tmp_path):
    T_vehicle_camera = np.eye(4)
    T_vehicle_camera[:3, :3] = poses.rotation_towards(90.0, 30.0, 10.0)
    T_vehicle_camera[:3, 3] = [0.1, 0.2, 0.3]
    pose = poses.pose_from_matrix(T_vehicle_camera)
    places = [
        {"position_m": [0.1, 0.2, 0.3], "yaw_deg": 90, "elevation_deg": 30, "roll_deg": 10},
        {"T_vehicle_camera": T_vehicle_camera.tolist()},
        {"T_vehicle_camera": {"wxyz": pose[:4].tolist(), "xyz_m": pose[4:].tolist()}},
        {"T_camera_vehicle": np.linalg.inv(T_vehicle_camera).tolist()},
    ]
    cameras = [one_camera(f"c{i}") | place for i, place in enumerate(places)]
    rig = files.load_rig(write(tmp_path, {"cameras": cameras}))
    matrices = np.asarray(rig.Ts_camera_vehicle.as_matrix())
    np.testing.assert_allclose(matrices, [np.linalg.inv(T_vehicle_camera)] * 4, atol=1e-12)
    # Looking left and 30 degrees up; turned clockwise, its x axis dips below the horizon.
    axis, x_axis = T_vehicle_camera[:3, 2], T_vehicle_camera[:3, 0]
    np.testing.assert_allclose(axis, [0, np.sqrt(3) / 2, 0.5], atol=1e-12)
    assert x_axis[0] > 0.9
    assert x_axis[2] < 0


def test_small_rounding_in_a_rotation_is_repaired(tmp_path):
    T = np.eye(4)
    T[:3, :3] = np.round(poses.rotation_towards(33.0, 0.0, 0.0), 4)
    rig = files.load_rig(
        write(tmp_path, {"cameras": [one_camera("c") | {"T_vehicle_camera": T.tolist()}]})
    )
    R = np.asarray(rig.Ts_camera_vehicle.rotation().as_matrix())[0]
    np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-12)
    np.testing.assert_allclose(R.T, poses.rotation_towards(33.0, 0.0, 0.0), atol=1e-4)


# --- what a person gets for bad input ------------------------------------------------


def one_camera(name: str) -> dict[str, Any]:
    return {
        "name": name,
        "lens": "equidistant",
        "focal_px": [319.0, 320],
        "center_px": [401.0, 202.0],
        "image_size_px": [820, 410],
    }


ONE_CAMERA = one_camera("front") | {"position_m": [0, 0, 0], "yaw_deg": 0}


class _NoAliases(yaml.SafeDumper):
    def ignore_aliases(self, data: Any) -> bool:
        return True


def write(folder: Path, data: Any, name: str = "rig.yaml") -> Path:
    path = folder / name
    path.write_text(data if isinstance(data, str) else yaml.dump(data, Dumper=_NoAliases))
    return path


def sigma_of(position_m: list[float], rotation_deg: list[float]) -> dict[str, Any]:
    return {"sigma": {"position_m": position_m, "rotation_deg": rotation_deg}}


MIRROR = [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, -1, 0], [0, 0, 0, 1]]
BAD_CAMERAS = [
    ({"focal_px": [0, 319]}, "cameras.front.focal_px[0]: must be > 0, got 0"),
    ({"focal_px": [1, float("nan")]}, "cameras.front.focal_px[1]: must be finite, got nan"),
    ({"focal_px": [319]}, "cameras.front.focal_px: must have at least 2 entries, got 1"),
    ({"focal_px": 319}, "cameras.front.focal_px: must be a list, got 319"),
    ({"focal_px": ["319", 319]}, "cameras.front.focal_px[0]: must be a number, got the text '319'"),
    ({"center_px": [1e300, 1]}, "cameras.front.center_px[0]: must be <= 1e+09, got 1e+300"),
    ({"lens": "fisheye"},
     "cameras.front.lens: must be 'none', 'radtan', 'rational', 'thin_prism', "),
    ({"distortion": [1, 2, 3]}, "cameras.front.distortion: must have 4 coefficients"),
    ({"lens": "radtan", "distortion": [1] * 3}, "front.distortion: must have 4 or 5 coefficients"),
    ({"lens": "double_sphere", "distortion": [0.1, 1.2]},
     "front.distortion: alpha of the lens double_sphere must be from 0 to 1, got 1.2"),
    ({"lens": "omni", "distortion": [-0.1, 0, 0, 0, 0]},
     "front.distortion: xi of the lens omni must be at least 0, got -0.1"),
    ({"image_size_px": [820.5, 410]}, "front.image_size_px[0]: must be a whole number, got 820.5"),
    ({"image_size_px": [820, 0]}, "cameras.front.image_size_px[1]: must be >= 1, got 0"),
    ({"focal": 3}, "cameras.front.focal: unknown key"),
    ({"name": "1 2"}, "cameras.1 2.name: must be a name"),
    ({"position_m": None}, "cameras.front: needs exactly one of T_vehicle_camera"),
    ({"T_camera_vehicle": np.eye(4).tolist()}, "got T_camera_vehicle and position_m"),
    ({"yaw_deg": None}, "cameras.front: position_m needs yaw_deg"),
    ({"position_m": None, "T_vehicle_camera": MIRROR}, "T_vehicle_camera: the 3x3 part has det(R)"),
    ({"position_m": None, "T_vehicle_camera": np.diag([1, 1, 1.01, 1]).tolist()},
     "cameras.front.T_vehicle_camera: the 3x3 part is not a rotation"),
    ({"position_m": None, "T_vehicle_camera": np.ones((4, 4)).tolist()},
     "cameras.front.T_vehicle_camera: the last row must be 0 0 0 1"),
    ({"position_m": None, "T_vehicle_camera": np.eye(3).tolist()},
     "cameras.front.T_vehicle_camera[0]: must have at least 4 entries, got 3"),
    ({"position_m": None, "T_vehicle_camera": {"wxyz": [1, 1, 0, 0], "xyz_m": [0, 0, 0]}},
     "cameras.front.T_vehicle_camera.wxyz: must have length 1, got 1.41421"),
    (sigma_of([-0.01, 0, 0], [0] * 3), "front.sigma.position_m[0]: must be >= 0, got -0.01"),
    (sigma_of([0, 0.51, 0], [0] * 3), "front.sigma.position_m[1]: must be <= 0.5, got 0.51"),
    ({"sigma": {"position_m": [0.01] * 3}}, "front.sigma: rotation_deg is missing: it goes with"),
]  # fmt: skip


@pytest.mark.parametrize(("change", "expected"), BAD_CAMERAS, ids=lambda v: str(v)[:40])
def test_a_bad_camera_is_named_with_its_key(tmp_path, change, expected):
    camera = ONE_CAMERA | change
    path = write(tmp_path, {"cameras": [{k: v for k, v in camera.items() if v is not None}]})
    line = problem(files.load_rig, path)
    assert line.startswith(f"{path}: ")
    assert expected in line


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("", "the file is empty"),
        ("[1, 2]", "must be a mapping of keys to values, got a list"),
        ("cameras: []", "cameras: must have at least 1 entries, got 0"),
        ("cameras: [3]", "cameras[0]: must be a mapping, got 3"),
        ("cameras:\ncameras:", "line 2: duplicate key 'cameras'"),
        ("cameras: &a [1]\nb: *a", "aliases (*name) are not supported"),
        ("a: " + "[" * 60, "nested deeper than 24 levels"),
        ("a: !!python/object/apply:os.system ['true']", "is not valid YAML"),
        ("a: [1, 2", "is not valid YAML: line 1"),
        ("a: \x01", "is not valid YAML"),
        ("1: 2", "the key 1 must be a word"),
        (
            "cameras: [{a}, {a}]".replace("{a}", json.dumps(ONE_CAMERA)),
            "cameras: the name 'front' is used twice",
        ),
        ("camera: 3", "is neither a rig (`cameras:`) nor a Kalibr camchain (`cam0:`)"),
    ],
)
def test_bad_yaml_is_one_line(tmp_path, text, expected):
    path = write(tmp_path, text)
    line = problem(files.load_rig, path)
    assert line.startswith(f"{path}: ")
    assert expected in line


def test_what_is_no_text_file_is_one_line(tmp_path):
    assert "no such file" in problem(files.load_rig, tmp_path / "none.yaml")
    assert "is a folder" in problem(files.load_rig, tmp_path)
    (tmp_path / "b.yaml").write_bytes(b"\x89PNG\r\n\xff\xfe")
    assert "is not UTF-8 text (byte 0)" in problem(files.load_rig, tmp_path / "b.yaml")
    (tmp_path / "big.yaml").write_bytes(b"#" * (3 * 2**20))
    assert "is larger than 2 MiB" in problem(files.load_rig, tmp_path / "big.yaml")
    assert "can't be read" in problem(files.load_rig, Path("a\0b"))


def test_numbers_are_those_of_yaml_1_2(tmp_path):
    text = (QCAR / "vehicle.yaml").read_text()
    path = write(tmp_path, text.replace(": 10.0", ": 1e1").replace(": 5.0", ": 010"))
    assert float(files.load_vehicle(path).speed_per_throttle_mps) == 10.0
    assert float(files.load_vehicle(path).steering_rate_limit_radps) == 10.0
    path = write(tmp_path, text.replace(": 10.0", ": 1:30"))  # sexagesimal in YAML 1.1
    assert "must be a number, got the text '1:30'" in problem(files.load_vehicle, path)


MARKER = {"id": 0, "family": "tag36h11", "size_m": 2.0, "corners_world_m": _SQUARE.tolist()}
BAD_MARKERS = [
    ({"corners_world_m": (1.1 * _SQUARE).tolist()}, "must be a square with sides of 2 m: corner ["),
    ({"corners_world_m": _SQUARE[[0, 1, 3, 2]].tolist()}, "TL TR BR BL must be a square"),
    ({"corners_world_m": np.c_[_SQUARE[:, :2], [0.3, 0, 0.3, 0]].tolist()},
     "corners_world_m: TL TR BR BL must be a square"),
    ({"corners_world_m": (_SQUARE * [1.1, 0.9, 1]).tolist()}, "TL TR BR BL must be a square"),
    ({"corners_world_m": _SQUARE[:, :2].tolist()}, "corners_world_m[0]: must have at least 3"),
    ({"corners_world_m": None}, "markers[0]: needs exactly one of corners_world_m, T_world_marker"),
    ({"T_world_marker": np.eye(4).tolist()}, "markers[0]: needs exactly one of"),
    ({"family": "tag37h11"}, "markers[0].family: unknown 'tag37h11': expected one of tag16h5,"),
    ({"id": 587}, "markers[0].id: tag36h11 has ids 0 to 586, got 587"),
    ({"id": "7"}, "markers[0].id: must be a whole number, got the text '7'"),
]  # fmt: skip


@pytest.mark.parametrize(("change", "expected"), BAD_MARKERS, ids=lambda v: str(v)[:40])
def test_a_bad_marker_is_named_with_its_key(tmp_path, change, expected):
    entry = {key: value for key, value in (MARKER | change).items() if value is not None}
    path = write(tmp_path, {"markers": [entry]}, "markers.yaml")
    line = problem(files.load_markers, path)
    assert line.startswith(f"{path}: markers[0]")
    assert expected in line


def test_a_marker_stands_once_in_a_map(tmp_path):
    other_family = MARKER | {"family": "tag25h9"}
    assert len(files.load_markers(write(tmp_path, {"markers": [MARKER, other_family]})).ids) == 2
    line = problem(files.load_markers, write(tmp_path, {"markers": [MARKER, MARKER]}))
    assert "marker 0 of tag36h11 is in the map twice" in line


# --- bases that are no cars, and gyros ---

DIFFERENTIAL = {
    "base": "differential",
    "forward_limit_mps": 1.2,
    "turn_limit_radps": 3.0,
    "time_constant_s": 0.15,
}
OMNI = DIFFERENTIAL | {"base": "mecanum", "left_limit_mps": 0.7}
CAR = yaml.safe_load((QCAR / "vehicle.yaml").read_text())


def vehicle_file(folder: Path, data: dict[str, Any]) -> Path:
    return write(folder, data, "vehicle.yaml")


def test_a_base_as_its_file_says(tmp_path):
    base = files.load_vehicle(vehicle_file(tmp_path, DIFFERENTIAL | {"sigma": {"turn_gain": 0.1}}))
    assert isinstance(base, TwistBase)
    np.testing.assert_allclose(base.limits, [1.2, 0.0, 3.0])
    np.testing.assert_allclose(
        base.sensor_sigma, [DEFAULT_TWIST_SIGMA[0], 0.1, *DEFAULT_TWIST_SIGMA[2:]]
    )
    assert base.gyro is None
    exact = dict.fromkeys(("speed_scale", "turn_gain", "turn_offset_radpm", "camera_delay_s"), 0.0)
    assert files.load_vehicle(vehicle_file(tmp_path, OMNI | {"sigma": exact})).sensor_sigma is None


@pytest.mark.parametrize("data", [DIFFERENTIAL, OMNI, CAR], ids=["differential", "omni", "car"])
@pytest.mark.parametrize("gyro", [None, {"class": "tactical", "delay_s": 0.004}])
def test_a_saved_vehicle_reads_back_bit_for_bit(data, gyro, tmp_path):
    given = data if gyro is None else data | {"gyro": gyro}
    vehicle = files.load_vehicle(vehicle_file(tmp_path, given))
    files.save_vehicle(tmp_path / "saved.yaml", vehicle)
    again = files.load_vehicle(tmp_path / "saved.yaml")
    assert leaves_equal(again, vehicle)
    if gyro is not None:
        assert vehicle.gyro.delay_s == 0.004
        assert vehicle.gyro.noise_density == GYROS["tactical"].noise_density


def test_a_bad_base_is_named_with_its_key(tmp_path):
    for changes, told in [
        ({"base": "hovercraft"}, "base: must be"),
        ({"turn_limit_radps": -1.0}, "turn_limit_radps: must be > 0"),
        ({"forward_limit_mps": 1e5}, "forward_limit_mps: must be from"),
        ({"left_limit_mps": 0.5}, "base differential can't move to its left"),
        ({"base": "omni"}, "base omni needs left_limit_mps"),
        ({"wheelbase_m": 0.3}, "wheelbase_m: unknown key"),
        ({"sigma": {"steering_gain": 0.1}}, "sigma: unknown steering_gain"),
        ({"sigma": {"turn_offset_radpm": 0.9}}, "sigma: turn_offset_radpm must be at most 0.35"),
        ({"gyro": {"class": "best"}}, "gyro.class: must be"),
        ({"gyro": {"noise_density": 0.0}}, "gyro.noise_density: must be"),
        ({"gyro": {"delay_s": 3.0}}, "gyro.delay_s: must be"),
        ({"gyro": {"bias": 3.0}}, "gyro.bias: unknown key"),
    ]:
        path = vehicle_file(tmp_path, DIFFERENTIAL | changes)
        assert problem(files.load_vehicle, path).startswith(f"{path}: {told}")


def test_where_only_cars_drive_other_vehicles_are_refused(tmp_path):
    for data, told in (
        (DIFFERENTIAL, "base: must be ackermann here"),
        (CAR | {"gyro": {"class": "consumer"}}, "gyro: must be left out here"),
    ):
        path = vehicle_file(tmp_path, data)
        assert problem(files.load_car, path).startswith(f"{path}: {told}")
    assert (
        float(files.load_car(vehicle_file(tmp_path, CAR | {"base": "ackermann"})).wheelbase_m) > 0
    )


# --- files of other tools ------------------------------------------------------------

KALIBR = """
cam0:
  cam_overlaps: [1]
  camera_model: pinhole
  distortion_coeffs: [-0.01, 0, 0.01, 0]
  distortion_model: equi
  intrinsics: [470, 471.5, 639.7, 524.4]
  resolution: [1280, 1024]
  rostopic: /cam0/image_raw
  T_cam_imu:
    - [0, -1, 0, 0.1]
    - [0, 0, -1, 0.2]
    - [1, 0, 0, 0.3]
    - [0, 0, 0, 1]
cam1:
  camera_model: pinhole
  distortion_coeffs: [0.1, -0.02, 0.001, 0.002]
  distortion_model: radtan
  intrinsics: [400.0, 401.0, 320.0, 240.0]
  resolution: [640, 480]
  T_cn_cnm1:
    - [0, 0, 1, 0.5]
    - [0, 1, 0, 0]
    - [-1, 0, 0, 0]
    - [0, 0, 0, 1.0]
"""
ROS = """
image_width: 640
image_height: 480
camera_name: narrow
camera_matrix: {rows: 3, cols: 3, data: [400.5, 0.0, 320.0, 0.0, 401.0, 240.0, 0.0, 0.0, 1.0]}
distortion_model: plumb_bob
distortion_coefficients: {rows: 1, cols: 5, data: [0.1, -0.02, 0.001, 0.002, 0.003]}
rectification_matrix: {rows: 3, cols: 3, data: [1, 0, 0, 0, 1, 0, 0, 0, 1]}
"""


def test_a_camchain_may_have_k3_and_lenses_beside_the_pinhole(tmp_path):
    """As TagSLAM's files do, under ROS's name of the lens."""
    k3 = yaml.safe_load(KALIBR)
    bend = [0.1, -0.02, 0.001, 0.002, 0.003]
    k3["cam1"] |= {"distortion_model": "plumb_bob", "distortion_coeffs": bend}
    for data, name, lens, focal_px, coefficients in (
        (k3, "cam1", "radtan", 400, bend),
        (seed_texts.SPHERES, "cam0", "omni", 1200, [1.5, -0.1, 0.02, 0.001, 0.002]),
        (seed_texts.SPHERES, "cam1", "double_sphere", 380, [-0.2, 0.6]),
        (seed_texts.SPHERES, "cam2", "eucm", 470, [0.6, 1.1]),
    ):
        camera, _ = files.load_camera(write(tmp_path, data), name)
        assert camera.lenses == (lens,)
        assert float(camera.focal_px[0]) == focal_px
        np.testing.assert_array_equal(camera.distortion[: len(coefficients)], coefficients)


def test_a_camchain_is_chained(tmp_path):
    rig = files.load_rig(write(tmp_path, KALIBR))
    assert rig.names == ("cam0", "cam1")
    assert rig.image_sizes_px == ((1280, 1024), (640, 480))
    data = yaml.safe_load(KALIBR)
    T_cam0_imu = np.array(data["cam0"]["T_cam_imu"], float)
    T_cam1_imu = np.array(data["cam1"]["T_cn_cnm1"], float) @ T_cam0_imu
    matrices = np.asarray(rig.Ts_camera_vehicle.as_matrix())
    np.testing.assert_allclose(matrices, [T_cam0_imu, T_cam1_imu], atol=1e-12)
    inverted = yaml.safe_load(KALIBR)  # as OpenVINS writes it
    inverted["cam0"]["T_imu_cam"] = np.linalg.inv(inverted["cam0"].pop("T_cam_imu")).tolist()
    again = files.load_rig(write(tmp_path, inverted))
    np.testing.assert_allclose(again.Ts_camera_vehicle.as_matrix(), matrices, atol=1e-12)


def numbers(camera: Any) -> list[float]:
    assert not np.any(camera.distortion[5:])
    return np.concatenate([camera.focal_px, camera.center_px, camera.distortion[:5]]).tolist()


def test_a_camera_is_chosen_by_name(tmp_path):
    left, size = files.load_camera(QCAR / "rig.yaml", "left")
    assert (left.lenses, size) == (("equidistant",), (820, 410))
    line = problem(files.load_camera, QCAR / "rig.yaml")
    assert line.endswith("holds several cameras: choose one of front, right, rear, left")
    assert "has no camera 'up'" in problem(files.load_camera, QCAR / "rig.yaml", "up")
    camera, _ = files.load_camera(write(tmp_path, KALIBR), "cam1")
    assert numbers(camera)[:2] == [400.0, 401.0]
    files.load_camera(write(tmp_path, ROS), "narrow")
    line = problem(files.load_camera, write(tmp_path, ROS), "wide")
    assert line.endswith("has no camera 'wide': choose one of narrow")


VEHICLE, ROUTE = ((QCAR / name).read_text() for name in ("vehicle.yaml", "route.yaml"))
TURNED = "    - [0, -1, 0, 0.1]", "    - [0, 1, 0, 0.1]"
DS_BENT = "camera_model: ds", "distortion_model: radtan\n  camera_model: ds"
TILTED = "cols: 5, data: [0.1,", "cols: 14, data: [0.1, 0.2, 0.3, 0.4, 0.5, 0, 0, 0, 0, 0,"
FOV = "cam0.camera_model: must be 'pinhole', 'omni', 'ds' or 'eucm', got the text 'fov'"
ALPHA = "cam1.intrinsics: alpha of the lens double_sphere must be from 0"
CHANGED = {
    files.load_vehicle: (VEHICLE, [
        ("wheelbase_m: 0.256", "wheelbase_m: 0", "wheelbase_m: must be > 0, got 0"),
        ("wheelbase_m: 0.256", "", "wheelbase_m: missing"),
        ("wheelbase_m:", "wheelbase:", "(and 1 more)"),
        ("steering_limit_rad: 0.5", "steering_limit_rad: 30", "must be < 1.5708"),
    ]),
    files.load_route: (ROUTE, [
        ("[[1.30, 0.0], [0.50, 0.65]]", "[]", "waypoints_m: must have at least 1"),
        ("psi_deg: 125.0", "psi: 2", "start.psi_deg: missing"),
    ]),
    (lambda path: files.load_camera(path, "cam0")): (seed_texts.SPHERES, [
        ("[1.5, 1200", "[1200", "cam0.intrinsics: must be xi fu fv pu pv, got 4 numbers"),
        ("[1.5, ", "[-0.5, ", "cam0.intrinsics: xi of the lens omni must be at least 0, got -0.5"),
        ("0.6, 380", "1.6, 380", ALPHA),
        ("1.1, 470", "1.1, -470", "cam2.intrinsics: the focal lengths must be > 0"),
        ("model: radtan", "model: equi", "cam0.distortion_model: must be one of radtan, plumb_bob"),
        (*DS_BENT, "cam1.distortion_model: must"),
    ]),
    files.load_rig: (KALIBR, [
        ("camera_model: pinhole", "camera_model: fov", FOV),
        ("0.001, 0.002]", "0]", "cam1.distortion_coeffs: must have 4 or 5 numbers, got 3"),
        ("T_cam_imu", "T_imu", "cam0.T_cam_imu: missing"),
        (*TURNED, "cam0.T_cam_imu: the 3x3 part has det(R)"),
        ("\ncam1:", "\ncam2:", "cam1: missing, though there is cam2"),
    ]),
    files.load_camera: (ROS, [
        ("[400.5,", "[0.0,", "camera_matrix.data[0]: is 0: this camera has not been calibrated"),
        ("[400.5,", "[-1,", "camera_matrix.data[0]: the focal length must be > 0, got -1"),
        ("[400.5, 0.0", "[400.5, 0.5", "camera_matrix.data: must be fx 0 cx, 0 fy cy, 0 0 1"),
        ("[400.5, ", "[", "camera_matrix.data: must have 3 x 3 numbers, got 8"),
        ("plumb_bob", "mei", "distortion_model: must be one of plumb_bob"),
        ("plumb_bob", "equidistant", "distortion_coefficients.data: must be k1 k2 k3 k4"),
        ("image_width: 640", "", "image_width: missing"),
        (*TILTED, "has tilt coefficients that are not zero"),
    ]),
}  # fmt: skip


@pytest.mark.parametrize("load", CHANGED, ids=["vehicle", "route", "spheres", "camchain", "ros"])
def test_what_is_wrong_is_named_with_its_key(tmp_path, load):
    sound, changes = CHANGED[load]
    for old, new, expected in changes:
        assert old in sound
        path = write(tmp_path, sound.replace(old, new, 1))
        line = problem(load, path)
        assert line.startswith(f"{path}: ")
        assert expected in line


def test_json_is_as_strict_as_yaml(tmp_path):
    for text, expected in [
        ('{"a": 1, "a": 2}', "duplicate key 'a'"),
        ("{", "is not valid JSON"),
        ("[" * 100_000, "is not valid JSON"),
        ("{}", "is no camera file that jaxnav knows"),
    ]:
        assert expected in problem(files.load_camera, write(tmp_path, text, "camera.json"))


# --- out -----------------------------------------------------------------------------


def test_a_failed_write_leaves_the_older_file_and_nothing_else(tmp_path):
    files.atomic_write(tmp_path / "a.txt", "old")

    def fail() -> None:
        with files.atomic_path(tmp_path / "a.txt") as beside:
            assert beside.suffix == ".txt"
            beside.write_text("half")
            raise KeyError("interrupted")

    with pytest.raises(KeyError):
        fail()
    assert [(p.name, p.read_text()) for p in tmp_path.iterdir()] == [("a.txt", "old")]
    files.atomic_write(tmp_path / "a.txt", b"new")
    assert (tmp_path / "a.txt").read_bytes() == b"new"


def test_where_nothing_can_be_written_is_one_line(tmp_path):
    files.atomic_write(tmp_path / "file", "x")
    for path, expected in (
        (tmp_path, "it is a folder"),
        (tmp_path / "none" / "a", "no such file"),
        (tmp_path / "file" / "a", "can't be written"),
    ):
        assert expected in problem(files.atomic_write, path, "x")
    for path in (tmp_path / "file", tmp_path / "file" / "deep"):
        assert "is a file, not a folder" in problem(files.output_folder, path)
    for _ in range(2):
        assert files.output_folder(tmp_path / "deep" / "er").is_dir()
    (tmp_path / "closed").mkdir(mode=0o500)
    if os.geteuid():  # root may write everywhere
        assert "permission denied" in problem(files.output_folder, tmp_path / "closed")
        assert "permission denied" in problem(files.atomic_write, tmp_path / "closed" / "a", "x")


def test_json_has_plain_numbers_and_no_nan(tmp_path):
    data = {"a": np.float32(0.5), "b": [np.nan, np.arange(2)], "c": Path("x"), "d": np.bool_(True)}
    files.write_json(tmp_path / "a.json", data)
    read = json.loads((tmp_path / "a.json").read_text())
    assert read == {"a": 0.5, "b": [None, [0, 1]], "c": "x", "d": True}


def test_tum_is_translation_then_quaternion_with_w_last(tmp_path):
    Ts = np.array([[0.5, 0.1, 0.2, 0.3, 1.0, 2.0, 3.0]])
    files.write_tum(tmp_path / "a.tum", np.array([1532312185.929058]), Ts)
    row = np.loadtxt(tmp_path / "a.tum")
    np.testing.assert_allclose(row, [1532312185.929058, 1, 2, 3, 0.1, 0.2, 0.3, 0.5], atol=1e-6)
    with pytest.raises(ValueError, match="expected, got"):
        files.write_tum(tmp_path / "a.tum", np.array([1.0, 2.0]), Ts)
