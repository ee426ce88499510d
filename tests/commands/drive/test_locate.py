"""`jaxnav locate` on rendered images with known poses, and on a photograph."""

import json

import cv2
import jax.numpy as jnp
import jaxlie
import numpy as np
import pytest
import yaml
from PIL import Image

from jaxnav.cli import main
from jaxnav.detection import make_detector, marker_cells
from jaxnav.files import calib_dir, load_markers, load_rig
from jaxnav.sim.rendering import Renderer
from jaxnav.sim.scene import Scene

QCAR = calib_dir() / "qcar"
POSE = np.array([np.cos(1.0), 0, 0, np.sin(1.0), 0.9, -0.3, 0.0])  # heading 115 degrees


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


def write_camera(path, intrinsics, size_px):
    """A Kalibr camchain of the kind of lens that the QCar has, whose programs are there."""
    path.write_text(
        f"cam0: {{camera_model: pinhole, intrinsics: {intrinsics}, distortion_model: equidistant,"
        f" distortion_coeffs: [0, 0, 0, 0], resolution: {size_px}}}\n"
    )


def locate(*args) -> int:
    return main(["locate", *map(str, args)])


@pytest.fixture
def located(capsys):
    """What `--as-json` tells of a picture."""

    def run(*args) -> dict:
        assert locate(*args, "--as-json") == 0
        return json.loads(capsys.readouterr().out)

    return run


def position_m(marker: dict) -> np.ndarray:
    """In the camera, by the best pose."""
    return np.array(marker["poses"][0]["T_camera_marker"])[:3, 3]


CAMERA = ("--camera", QCAR / "rig.yaml", "--camera-name", "front", "--marker-size-m", "0.172")


def test_both_poses_of_a_rendered_marker(rendered, located, tmp_path, capsys):
    path, T_camera_marker = rendered
    (marker,) = located(path, *CAMERA, "--out", tmp_path / "drawn.png")["markers"]
    assert marker["id"] == 0
    assert len(marker["poses"]) == 2
    best = np.array(marker["poses"][0]["T_camera_marker"])
    truth = np.asarray(T_camera_marker.as_matrix())
    np.testing.assert_allclose(position_m(marker), truth[:3, 3], atol=0.01)
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
    # The table has a line for each pose, and the picture is as large as the photograph.
    assert locate(path, *CAMERA, "--out", tmp_path / "drawn.JPG") == 0
    lines = [line for line in capsys.readouterr().out.splitlines() if "note: " not in line]
    assert len(lines) == 3
    titles = ("x (m)", "error (px)", "ratio", "P(flip)", "sigma (m)", "sigma (deg)")
    assert all(word in lines[0] for word in titles)
    for name, form in (("drawn.png", "PNG"), ("drawn.JPG", "JPEG")):
        with Image.open(tmp_path / name) as drawn:
            assert (drawn.size, drawn.format) == ((820, 410), form)


def test_no_marker_in_view_is_a_result(located, tmp_path, capsys):
    cv2.imwrite(str(tmp_path / "grey.png"), np.full((410, 820), 120, np.uint8))
    assert locate(tmp_path / "grey.png", *CAMERA) == 0
    assert "no marker of tag36h11 in view" in capsys.readouterr().out
    assert located(tmp_path / "grey.png", *CAMERA)["markers"] == []


@pytest.mark.long
def test_a_blurred_photograph_is_restored_to_be_read(rendered, located, tmp_path):
    path, T_camera_marker = rendered
    blurred = cv2.blur(cv2.imread(str(path), cv2.IMREAD_GRAYSCALE), (9, 1))
    cv2.imwrite(str(tmp_path / "blurred.png"), blurred)
    assert not len(make_detector("aruco").detect(blurred))
    report = located(tmp_path / "blurred.png", *CAMERA)
    (marker,) = report["markers"]
    assert marker["id"] == 0
    assert any("is blurred by a motion" in note for note in report["notes"])
    np.testing.assert_allclose(position_m(marker), T_camera_marker.translation(), atol=0.02)


@pytest.mark.long
def test_every_tag_that_either_detector_finds_is_found_once(data_dir, located, tmp_path):
    photo = data_dir / "apriltag_photos" / "34085369442_304b6bafd9_c.jpg"
    write_camera(tmp_path / "camera.yaml", [700, 700, 399, 266], [799, 533])
    markers = located(photo, "--camera", tmp_path / "camera.yaml", *CAMERA[4:])["markers"]
    found_px = np.array([np.mean(marker["corners_px"], axis=0) for marker in markers])
    apart_px = np.linalg.norm(found_px[:, None] - found_px, axis=2) + 1e9 * np.eye(len(found_px))
    assert apart_px.min() > 5
    for backend in ("aruco", "apriltag"):
        if backend == "apriltag":
            pytest.importorskip("pyapriltags", reason="pyapriltags is not installed")
        detections = make_detector(backend).detect(cv2.imread(str(photo)))
        centres_px = detections.only(detections.refined).corners_px.mean(axis=1)
        nearest_px = np.linalg.norm(centres_px[:, None] - found_px, axis=2).min(axis=1)
        assert nearest_px.max() < 2
    assert len(markers) > 35


def test_a_real_photograph(data_dir, located, tmp_path):
    write_camera(tmp_path / "camera.yaml", [700, 700, 399, 266], [799, 533])
    photo = data_dir / "apriltag_photos" / "34139872896_defdb2f8d9_c.jpg"
    args = ("--camera", tmp_path / "camera.yaml", "--marker-size-m", "0.2")
    markers = located(photo, *args)["markers"]
    assert len(markers) >= 10
    # Equal cubes side by side on the ground: all about as far away.
    distances_m = [marker["poses"][0]["distance_m"] for marker in markers]
    assert np.ptp(distances_m) / np.median(distances_m) < 0.3


@pytest.mark.parametrize(
    ("changed", "note"),
    [
        (("--marker-size-m", "86"), "86 is 86 m: 0.086 if 86 are mm, 0.86 if they are cm"),
        pytest.param(
            ("--family", "4x4_50"),
            "1 of tag36h11 in view (id 0): --family tag36h11",
            marks=pytest.mark.long,
        ),
        ((), "rig.yaml has no sigmas of its lens"),
    ],
)
def test_what_does_not_add_up_is_noted(rendered, located, changed, note):
    given = dict(zip(CAMERA[::2], CAMERA[1::2], strict=True))
    given |= dict(zip(changed[::2], changed[1::2], strict=True))
    report = located(rendered[0], *(word for pair in given.items() for word in pair))
    assert any(note in told for told in report["notes"])


def with_lens(tmp_path, focal: float, **sigma) -> tuple:
    """The front camera's file, with another focal length and with sigmas of its lens."""
    rig = yaml.safe_load((QCAR / "rig.yaml").read_text())
    rig["cameras"] = [entry for entry in rig["cameras"] if entry["name"] == "front"]
    rig["cameras"][0]["focal_px"] = [focal] * 2
    if sigma:
        rig["cameras"][0]["sigma"] = sigma
    (tmp_path / "rig.yaml").write_text(yaml.safe_dump(rig))
    return ("--camera", tmp_path / "rig.yaml", "--marker-size-m", "0.172")


def test_an_unsure_lens_makes_the_position_unsure(rendered, located, tmp_path):
    """A focal length that is 1 % off is 1 % of the distance."""
    focal_px = float(load_rig(QCAR / "rig.yaml").cameras.focal_px[0, 0])
    found = {}
    for factor in (1.0, 1.01):
        sigma = {"focal_px": [0.01 * focal_px] * 2, "center_px": [1.5, 0.5]}
        report = located(rendered[0], *with_lens(tmp_path, factor * focal_px, **sigma))
        found[factor] = report["markers"][0]
        assert not any("sigmas of its lens" in note for note in report["notes"])
    pose = found[1.0]["poses"][0]
    of_focal_m = np.abs(position_m(found[1.01]) - position_m(found[1.0]))
    sigma_m = np.array(pose["lens_sigma_m"])
    assert sigma_m[2] == pytest.approx(of_focal_m[2], rel=0.05)
    across_m = np.array([1.5, 0.5]) * pose["distance_m"] / focal_px
    np.testing.assert_allclose(sigma_m[:2], np.hypot(of_focal_m[:2], across_m), rtol=0.15)
    assert np.all(np.array(pose["position_sigma_m"]) >= sigma_m)


def test_corners_that_no_pose_explains_count_as_unsure(located, tmp_path):
    """A marker foreshortened by 45 degrees without any perspective, as through a tele lens."""
    cells = np.kron(np.pad(marker_cells("tag36h11", 0), 1, constant_values=1), np.ones((40, 40)))
    paper = (255 * cells).astype(np.uint8)
    camera = with_lens(tmp_path, 400.0)
    found = []
    for width in (100, 71):
        image = np.full((410, 820), 255, np.uint8)
        image[100:200, 300 : 300 + width] = cv2.resize(
            paper, (width, 100), interpolation=cv2.INTER_AREA
        )
        cv2.imwrite(str(tmp_path / "tele.png"), cv2.GaussianBlur(image, (0, 0), 0.8))
        report = located(tmp_path / "tele.png", *camera)
        (marker,) = report["markers"]
        found.append(marker)
        off = any("is --camera that of this photograph" in note for note in report["notes"])
        assert off == (marker["misfit_sigmas"] > 5) == (width == 71)
    face, tele = found
    assert face["sigma_factor"] < 2 < 5 < tele["sigma_factor"]
    assert np.min(tele["corner_sigma_px"]) > 2 * np.max(face["corner_sigma_px"])


def test_a_picture_of_any_orientation_gives_the_pose_of_its_sensor(rendered, located, tmp_path):
    """EXIF asks viewers to turn it; the lens was calibrated as the sensor lies. All of them:
    tests/files/test_images.py."""
    path, T_camera_marker = rendered
    image, exif = Image.open(path), Image.Exif()
    image = image.transpose(Image.Transpose.FLIP_LEFT_RIGHT)  # the only way to see it mirrored
    exif[0x0112] = 5
    image.save(tmp_path / "phone.jpg", quality=98, exif=exif)
    report = located(tmp_path / "phone.jpg", *CAMERA)
    truth_m = T_camera_marker.translation()
    np.testing.assert_allclose(position_m(report["markers"][0]), truth_m, atol=0.02)
    assert any("(EXIF)" in note for note in report["notes"])
