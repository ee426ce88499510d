"""`jaxnav calibrate convert` with files in each tool's own form, and the pixels they mean."""

import json
from collections.abc import Callable

import cv2
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import yaml

from jaxnav import files
from jaxnav.core.models.camera import LENS_COEFFICIENTS
from jaxnav.files.reading import read_mapping
from jaxnav.files.rigs import CameraEntry, rig_text
from tests.helpers.conversions import (
    HELD,
    KALIBR,
    LAYOUT,
    PHOTONVISION,
    QCAR,
    ROS,
    TAGS,
    convert,
    problem,
    written,
)


def test_kalibrs_own_file_keeps_every_number(tmp_path, capsys):
    source = written(tmp_path, "camchain-imucam.yaml", KALIBR)
    rig = convert(source, "jaxnav", tmp_path / "rig.yaml")
    line = capsys.readouterr().out.splitlines()[-1]
    assert line == (
        "not carried over: cam0.cam_overlaps (1 entries), cam0.timeshift_cam_imu, "
        "cam1.timeshift_cam_imu"
    )
    assert files.load_rig(rig).names == ("left", "/cam1")
    again = yaml.safe_load(convert(rig, "kalibr", tmp_path / "again.yaml").read_text())
    for key, camera in yaml.safe_load(KALIBR).items():
        for left_out in ("cam_overlaps", "timeshift_cam_imu", "T_cn_cnm1"):
            camera.pop(left_out, None)
        assert {name: again[key][name] for name in camera} == camera
    # The rig is the same as the one that jaxnav makes of the camchain itself.
    direct, through = files.load_rig(source), files.load_rig(rig)
    for a, b in zip(jax.tree.leaves(direct), jax.tree.leaves(through), strict=True):
        np.testing.assert_array_equal(a, b)


def test_a_camchain_becomes_a_camera_info_each(tmp_path, capsys):
    """Kalibr's chain of cameras alone, which places none of them."""
    text = "\n".join(line for line in KALIBR.replace("T_cam_imu:", "ignored:").splitlines())
    source = written(tmp_path, "camchain.yaml", text)
    folder = convert(source, "ros", tmp_path / "ros")
    assert "T_cn_cnm1" in capsys.readouterr().out
    assert sorted(path.name for path in folder.iterdir()) == ["cam1.yaml", "left.yaml"]
    left = yaml.safe_load((folder / "left.yaml").read_text())
    K = [458, 0, 367.215, 0, 457.296, 248.375, 0, 0, 1]
    assert (left["image_width"], left["image_height"]) == (752, 480)
    assert left["camera_matrix"] == {"rows": 3, "cols": 3, "data": K}
    assert left["distortion_model"] == "plumb_bob"
    D = [-0.28340811, 0.07395907, 0.00019359, 1.76187114e-05, 0]
    assert left["distortion_coefficients"] == {"rows": 1, "cols": 5, "data": D}
    assert left["rectification_matrix"]["data"] == np.eye(3).ravel().tolist()
    assert (
        left["projection_matrix"]["data"] == np.c_[np.reshape(K, (3, 3)), [0] * 3].ravel().tolist()
    )
    right = yaml.safe_load((folder / "cam1.yaml").read_text())
    assert right["camera_name"] == "/cam1"
    assert right["distortion_model"] == "equidistant"
    assert right["distortion_coefficients"]["data"] == [-0.0149, 0, 1.5e-2, -7.0e-3]
    one = convert(source, "ros", tmp_path / "one.yaml", camera_name="left")
    assert one.read_text() == (folder / "left.yaml").read_text()


def test_ros_own_file_keeps_every_number(tmp_path, capsys):
    source = written(tmp_path, "left.yaml", ROS)
    opencv = convert(source, "opencv", tmp_path / "opencv.yaml")
    told = capsys.readouterr().out
    assert told.endswith("not carried over: rectification_matrix, projection_matrix\n")
    again = yaml.safe_load(convert(opencv, "ros", tmp_path / "again.yaml").read_text())
    assert capsys.readouterr().out.count("\n") == 1  # nothing is left out
    stored = yaml.safe_load(ROS)
    for key in ("image_width", "image_height", "camera_name", "camera_matrix"):
        assert again[key] == stored[key]
    assert again["distortion_coefficients"]["data"] == [-0.361976, 0.110510, 0.001014, 0.000505, 0]
    line = problem(source, "jaxnav", tmp_path / "rig.yaml", position_m=(0.0, 0.0, 0.0))
    assert line.endswith("can't be a camera's name (a letter first): give --camera-name")
    place = {"position_m": (0.2, 0.0, 0.1), "yaw_deg": 90.0, "camera_name": "left"}
    (tmp_path / "r").mkdir()
    rig = files.load_rig(convert(source, "jaxnav", tmp_path / "r" / "rig.yaml", **place))
    T_vehicle_camera = np.asarray(rig.Ts_camera_vehicle.inverse().as_matrix())[0]
    np.testing.assert_allclose(T_vehicle_camera[:3, 2:], [[0, 0.2], [1, 0], [0, 0.1]], atol=1e-15)


K = np.array([[400.1, 0, 320.12345678901234], [0, 401.0 / 3, 240.0], [0, 0, 1]])
D = np.array([1 / 3, -2e-7, 1e-20, 5.0, 3e-3, 0.25, 0.0, 1e-9, 2e-3, -1 / 7, 3e-3, 5e-4])


@pytest.mark.parametrize(
    ("lens", "count"),
    [("radtan", 5), ("rational", 8), ("thin_prism", 12), ("equidistant", 4)],
)
def test_opencv_reads_what_is_written_and_is_read(tmp_path, lens, count):
    """cv2 of this machine writes the file, and reads ours."""
    path = tmp_path / "cv.yml"
    store = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    store.write("calibration_time", "Thu 05 Nov 2020")
    store.write("image_width", 640)
    store.write("image_height", 480)
    store.write("camera_matrix", K)
    store.write("distortion_coefficients", D[:count])
    store.write("fisheye_model", int(lens == "equidistant"))
    store.write("avg_reprojection_error", 0.25)
    store.release()
    body = path.read_text().split("\n", 1)[1]
    for header in ("%YAML:1.0", "%YAML 1.2"):
        path.write_text(f"{header}\n{body}")
        ros = convert(path, "ros", tmp_path / "ros.yaml")
        ours = convert(ros, "opencv", tmp_path / "ours.yaml")
        assert ours.read_text().startswith("%YAML:1.0\n---\n")
        read = cv2.FileStorage(str(ours), cv2.FILE_STORAGE_READ)
        assert read.getNode("image_width").real() == 640
        assert read.getNode("image_height").real() == 480
        assert read.getNode("camera_name").string() == "cv"
        assert read.getNode("fisheye_model").real() == int(lens == "equidistant")
        np.testing.assert_array_equal(read.getNode("camera_matrix").mat(), K)
        stored = read.getNode("distortion_coefficients").mat().ravel()
        np.testing.assert_array_equal(stored, D[:count])
        read.release()


def test_photonvisions_own_file_keeps_every_number(tmp_path, capsys):
    source = written(tmp_path, "front.json", json.dumps(PHOTONVISION))
    opencv = convert(source, "opencv", tmp_path / "front.yaml")
    left_out = (
        "calobjectWarp (2 entries), observations (1 entries), calobjectSize, calobjectSpacing"
    )
    assert f"not carried over: {left_out}\n" in capsys.readouterr().out
    again = json.loads(convert(opencv, "photonvision", tmp_path / "back.json").read_text())
    assert again.keys() == PHOTONVISION.keys()
    assert again["resolution"] == PHOTONVISION["resolution"]
    assert again["cameraIntrinsics"] == PHOTONVISION["cameraIntrinsics"]
    assert again["distCoeffs"]["data"] == PHOTONVISION["distCoeffs"]["data"][:5]
    assert again["observations"] == []


def test_wpilibs_own_layout_faces_the_field(tmp_path, capsys):
    source = written(tmp_path, "2024-crescendo.json", json.dumps(LAYOUT, indent=2))
    path = convert(source, "jaxnav", tmp_path / "markers.yaml")
    assert "field (16.451 x 8.211 m, --field-size-m" in capsys.readouterr().out
    markers = files.load_markers(path)
    assert markers.ids == (7, 4, 6, 1)
    assert set(markers.families) == {"tag36h11"}
    np.testing.assert_array_equal(markers.size_m, [0.1651] * 4)
    Ts = np.asarray(markers.Ts_world_marker.as_matrix())
    # Towards the reader: along +x, back along -x, down the field's width, and 120 degrees round.
    facing = [[1, 0, 0], [-1, 0, 0], [0, -1, 0], [-0.5, np.sqrt(3) / 2, 0]]
    np.testing.assert_allclose(Ts[:, :3, 2], facing, atol=1e-12)
    # AprilTag's picture is upright, so OpenCV's, which ours is, stands on its head.
    np.testing.assert_allclose(Ts[:, :3, 1], [[0, 0, -1]] * 4, atol=1e-12)
    # Who reads tag 7 looks along -x, with +y on the right: there the upright tag has its right
    # edge, and the one on its head its left one.
    h, (x, y, z) = 0.1651 / 2, TAGS[7][0]
    corners = [[x, y + h, z - h], [x, y - h, z - h], [x, y - h, z + h], [x, y + h, z + h]]
    np.testing.assert_allclose(markers.corners_world_m[0], corners, atol=1e-12)

    again = json.loads(
        convert(path, "wpilib", tmp_path / "again.json", field_size_m=(16.451, 8.211)).read_text()
    )
    assert again["field"] == LAYOUT["field"]
    for tag, expected in zip(again["tags"], LAYOUT["tags"], strict=True):
        assert (tag["ID"], tag["pose"]["translation"]) == (
            expected["ID"],
            expected["pose"]["translation"],
        )
        wxyz, as_given = (t["pose"]["rotation"]["quaternion"] for t in (tag, expected))
        assert list(wxyz) == list("WXYZ")
        np.testing.assert_allclose(list(wxyz.values()), list(as_given.values()), atol=3e-16)


def test_the_field_is_what_the_map_spans_unless_it_is_told(tmp_path, capsys):
    convert(QCAR / "markers.yaml", "wpilib", tmp_path / "layout.json")
    field = json.loads((tmp_path / "layout.json").read_text())["field"]
    assert field == pytest.approx({"length": 0.172, "width": 1.47}, abs=1e-12)
    told = capsys.readouterr().out
    assert "1 marker on a field of 0.172 x 1.47 m" in told
    assert "not carried over: family tag36h11, size_m 0.172 (--marker-size-m on the way" in told


# --- the same pixels -----------------------------------------------------------------

PROJECT: dict[str, Callable] = {
    "radtan": cv2.projectPoints,
    "rational": cv2.projectPoints,
    "thin_prism": cv2.projectPoints,
    "equidistant": lambda points, r, t, K, D: cv2.fisheye.projectPoints(points, r, t, K, D),
}


@pytest.mark.parametrize(("to", "lens"), HELD)
def test_opencv_projects_with_the_numbers_of_the_file_to_our_pixels(tmp_path, to, lens):
    coefficients = [-0.21, 0.04, 0.003, -0.002, 0.01, 0.1, -0.02, 0.03, 2e-3, -1e-3, 3e-3, 5e-4]
    coefficients = coefficients[: LENS_COEFFICIENTS[lens]]
    camera = CameraEntry.create(
        "c",
        lens,
        [410.5, 409.0, 321.25, 239.5],
        coefficients,
        (640, 480),
        T_camera_vehicle=np.eye(4).tolist(),
    )
    rig = written(tmp_path, "rig.yaml", rig_text([camera]))
    path = convert(rig, to, tmp_path / ("c.json" if to == "photonvision" else "c.yaml"))
    data = read_mapping(path)
    matrix = data.get("camera_matrix") or data["cameraIntrinsics"]
    lens_part = data.get("distortion_coefficients") or data["distCoeffs"]
    points = np.random.default_rng(0).uniform([-1, -1, 1], [1, 1, 3], (50, 1, 3))
    expected, _ = PROJECT[lens](
        points,
        np.zeros(3),
        np.zeros(3),
        np.reshape(matrix["data"], (3, 3)),
        np.array(lens_part["data"]),
    )
    ours = files.load_rig(rig).camera(0).project(jnp.asarray(points[:, 0]))
    np.testing.assert_allclose(ours, expected[:, 0], atol=1e-9)
