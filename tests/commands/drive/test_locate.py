"""`jaxnav locate` on rendered images with known poses, and on a photograph."""

import json

import cv2
import jax.numpy as jnp
import jaxlie
import numpy as np
import pytest

from jaxnav.cli import main
from jaxnav.files import calib_dir, load_markers, load_rig
from jaxnav.simulation.rendering import Renderer
from jaxnav.simulation.scene import Scene

QCAR = calib_dir() / "qcar"
POSE = np.array([np.cos(1.0), 0, 0, np.sin(1.0), 0.9, -0.3, 0.0])  # heading 115 degrees


@pytest.fixture(autouse=True)
def keep_the_compile_cache(monkeypatch):
    """Commands choose a cache of their own; tests keep theirs."""
    monkeypatch.setenv("JAX_COMPILATION_CACHE_DIR", "kept")


@pytest.fixture(scope="module")
def rendered(tmp_path_factory):
    """The paper's marker in the QCar's front camera: a file, and T_camera_marker."""
    rig, markers = load_rig(QCAR / "rig.yaml"), load_markers(QCAR / "markers.yaml")
    image = Renderer(Scene.create(markers), rig).render_still(POSE, np.random.default_rng(0))[0]
    path = tmp_path_factory.mktemp("locate") / "front.png"
    cv2.imwrite(str(path), image)
    T_camera_vehicle = jaxlie.SE3(rig.Ts_camera_vehicle.wxyz_xyz[0])
    T_world_vehicle = jaxlie.SE3(jnp.asarray(POSE))
    T_world_marker = jaxlie.SE3(markers.Ts_world_marker.wxyz_xyz[0])
    return path, T_camera_vehicle @ T_world_vehicle.inverse() @ T_world_marker


def locate(*args) -> int:
    return main(["locate", *map(str, args)])


CAMERA = ("--camera", QCAR / "rig.yaml", "--camera-name", "front", "--marker-size-m", "0.172")


def test_both_poses_of_a_rendered_marker(rendered, tmp_path, capsys):
    path, T_camera_marker = rendered
    assert locate(path, *CAMERA, "--json", "--out", tmp_path / "drawn.png") == 0
    report = json.loads(capsys.readouterr().out)
    (marker,) = report["markers"]
    assert marker["id"] == 0
    assert len(marker["poses"]) == 2
    best = np.array(marker["poses"][0]["T_camera_marker"])
    truth = np.asarray(T_camera_marker.as_matrix())
    np.testing.assert_allclose(best[:3, 3], truth[:3, 3], atol=0.01)
    turn = np.arccos(np.clip((np.trace(best[:3, :3].T @ truth[:3, :3]) - 1) / 2, -1, 1))
    assert np.rad2deg(turn) < 2
    # The mirrored pose is nearly as far away and looks elsewhere.
    other = np.array(marker["poses"][1]["T_camera_marker"])
    np.testing.assert_allclose(other[:3, 3], truth[:3, 3], atol=0.05)
    assert np.arccos(other[:3, 2] @ truth[:3, 2]) > np.deg2rad(20)
    assert marker["flip_probability"] < 0.01
    assert 0 < marker["error_ratio"] < 1
    errors_sigma = (best[:3, 3] - truth[:3, 3]) / marker["poses"][0]["position_sigma_m"]
    assert np.all(np.abs(errors_sigma) < 4)
    assert cv2.imread(str(tmp_path / "drawn.png")) is not None


def test_the_table_has_a_line_for_each_pose(rendered, capsys):
    assert locate(rendered[0], *CAMERA) == 0
    lines = capsys.readouterr().out.strip().splitlines()
    assert len(lines) == 3
    assert all(
        word in lines[0]
        for word in ("x (m)", "error (px)", "ratio", "P(flip)", "sigma (m)", "sigma (deg)")
    )


def test_no_marker_in_view_is_a_result(tmp_path, capsys):
    cv2.imwrite(str(tmp_path / "grey.png"), np.full((410, 820), 120, np.uint8))
    assert locate(tmp_path / "grey.png", *CAMERA) == 0
    assert "no marker of tag36h11 in view" in capsys.readouterr().out
    assert locate(tmp_path / "grey.png", *CAMERA, "--json") == 0
    assert json.loads(capsys.readouterr().out)["markers"] == []


def test_a_real_photograph(data_dir, tmp_path, capsys):
    (tmp_path / "camera.yaml").write_text(
        "cam0: {camera_model: pinhole, intrinsics: [700, 700, 399, 266], distortion_model: none,"
        " distortion_coeffs: [], resolution: [799, 533]}\n"
    )
    photo = data_dir / "apriltag_photos" / "34139872896_defdb2f8d9_c.jpg"
    args = ("--camera", tmp_path / "camera.yaml", "--marker-size-m", "0.2", "--json")
    assert locate(photo, *args) == 0
    markers = json.loads(capsys.readouterr().out)["markers"]
    assert len(markers) >= 10
    # Equal cubes side by side on the ground: all about as far away.
    distances_m = [marker["poses"][0]["distance_m"] for marker in markers]
    assert np.ptp(distances_m) / np.median(distances_m) < 0.3


@pytest.mark.parametrize(
    ("args", "message"),
    [
        (("missing.png", *CAMERA), "missing.png: can't be read: no such file"),
        (("{tmp}/text.png", *CAMERA), "text.png: is not an image"),
        (("{tmp}/empty.png", *CAMERA), "empty.png: is not an image"),
        (("{tmp}/small.png", *CAMERA), "is 64 x 48 pixels, but --camera"),
        (("{tmp}/small.png", *CAMERA[:4], "--marker-size-m", "0"), "--marker-size-m: must be pos"),
        (("{tmp}/small.png", *CAMERA[:4], "--marker-size-m", "x"), "--marker-size-m"),
        (("{tmp}/small.png", *CAMERA[:2], *CAMERA[4:]), "front"),
        (("{tmp}/small.png", *CAMERA, "--family", "tag99h1"), "tag99h1"),
        (("{tmp}/small.png", "--camera", "none.yaml", *CAMERA[4:]), "none.yaml"),
        (("{tmp}/small.png", "--camera", "{tmp}/zero.yaml", *CAMERA[4:]), "intrinsics"),
    ],
)
def test_bad_input_is_one_line_and_exit_code_2(tmp_path, capsys, args, message):
    (tmp_path / "text.png").write_text("not an image")
    (tmp_path / "empty.png").write_bytes(b"")
    cv2.imwrite(str(tmp_path / "small.png"), np.zeros((48, 64), np.uint8))
    (tmp_path / "zero.yaml").write_text(
        "cam0: {camera_model: pinhole, intrinsics: [0, 1, 2, 3], distortion_model: none,"
        " distortion_coeffs: [], resolution: [64, 48]}\n"
    )
    code = locate(*(str(arg).format(tmp=tmp_path) for arg in args))
    error = capsys.readouterr().err
    assert code == 2
    assert len(error.strip().splitlines()) == 1
    assert message in error
