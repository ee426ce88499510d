"""`jaxnav demo`: two methods that drive from images, and the files it leaves; of what people use
otherwise, that its corners and its choice are OpenCV's own."""

import json
from typing import Any

import cv2
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jaxlie import SE3, SO3

from jaxnav.cli import main
from jaxnav.commands.simulate.demo import (
    OPENCV_SELECTOR,
    OPENCV_SIGMA_PX,
    OpenCVDetector,
    overall,
    overall_lines,
)
from jaxnav.commands.simulate.rendered_world import RenderedWorld
from jaxnav.core.filter.selectors import make_selector
from jaxnav.core.models.geometry import T_world_vehicle_from_planar
from jaxnav.core.models.markers import CORNER_SIGNS, MarkerMap
from jaxnav.core.models.rig import CameraRig
from jaxnav.core.navigator import Navigator
from jaxnav.core.pose.observation import Observation
from jaxnav.detection import marker_cells
from jaxnav.files import calib_dir, load_markers, load_rig, load_vehicle, write_params

QCAR = calib_dir() / "qcar"
ENDINGS = ("", "_truth", "_alongside")
TRAJECTORIES = ("our_method", "our_method_truth", *(f"opencv_first_pose{s}" for s in ENDINGS))


@pytest.mark.long
def test_both_methods_drive_from_images_and_one_listens(tmp_path, capsys, monkeypatch):
    """What people use otherwise drives by itself, and hears the images of our drive."""
    made = {}

    def navigator(world: RenderedWorld, selector: str) -> Navigator:
        made[selector] = navigator_of(world, selector)
        return made[selector]

    navigator_of = RenderedWorld.navigator
    monkeypatch.setattr(RenderedWorld, "navigator", navigator)
    assert main(["demo", "--out", str(tmp_path), "--headless"]) == 0
    assert list(made) == ["multi-hypothesis", "lowest-reprojection"]
    # The same filter: either has the gate.
    gates = [float(one.motion.gate_nis) for one in made.values()]
    assert gates[0] == gates[1] < np.inf
    summary = json.loads((tmp_path / "summary.json").read_text())
    ours, opencv = summary["drives"]["our_method"], summary["drives"]["opencv_first_pose"]
    assert ours["reached"] is True
    assert ours["steps"] == pytest.approx(ours["duration_s"] * 15 + 1, abs=0.01)
    assert ours["marker_seen_fraction"] > 0.95
    assert ours["position_rmse_m"] < 0.05
    assert ours["yaw_rmse_deg"] < 2
    assert ours["wrong_branch_fraction"] < 0.05
    assert ours["wrong_heading_fraction"] == 0
    heard = summary["alongside"]
    for other in (opencv, heard):
        assert other["position_rmse_m"] > 10 * ours["position_rmse_m"]
        # It is told the truth about its corners.
        assert OPENCV_SIGMA_PX / 1.25 < other["corner_rms_px"] < OPENCV_SIGMA_PX * 1.25
    assert ours["corner_rms_px"] < 0.15

    lengths = {}
    for name in TRAJECTORIES:
        rows = np.loadtxt(tmp_path / f"{name}.tum")
        lengths[name] = len(rows)
        assert rows.shape[1] == 8
    assert lengths["opencv_first_pose_truth"] == opencv["steps"]
    assert lengths["our_method"] == lengths["our_method_truth"] == ours["steps"]
    assert lengths["opencv_first_pose_alongside"] <= ours["steps"]
    # It ends inside the last waypoint's radius.
    truth = np.loadtxt(tmp_path / "our_method_truth.tum")
    assert np.linalg.norm(truth[-1, 1:3] - [0.5, 0.65]) < 0.2
    for picture in ("report.png", "mosaic.png"):
        assert cv2.imread(str(tmp_path / picture)).shape[1] > 800
    first, second, third, rates, _ = capsys.readouterr().out.splitlines()
    assert first.startswith("seed 0, our method: reached all waypoints in ")
    assert f"position RMSE {ours['position_rmse_m']:.3f} m" in first
    assert second.startswith("seed 0, OpenCV, first pose: ")
    assert f"position RMSE {opencv['position_rmse_m']:.3f} m" in second
    assert third.startswith("seed 0, OpenCV, first pose, on the images of our method: ")
    assert f"position RMSE {heard['position_rmse_m']:.3f} m" in third
    assert rates.endswith("docs/guide/demo.md")


@pytest.mark.long
def test_another_route_marker_and_noise_with_the_same_command(tmp_path, capsys):
    (tmp_path / "markers.yaml").write_text(
        "markers: [{id: 7, family: 4x4_50, size_m: 0.25, corners_world_m: "
        "[[-0.125, 1.5, 0.4], [0.125, 1.5, 0.4], [0.125, 1.5, 0.15], [-0.125, 1.5, 0.15]]}]\n"
    )
    (tmp_path / "route.yaml").write_text(
        "{waypoints_m: [[0.3, -0.2]], waypoint_radius_m: 0.2,"
        " start: {x_m: 0.42, y_m: -0.5, psi_deg: 112}}\n"
    )
    # Of a bank, and of a filter: either method takes its own.
    params = {"selector.floor_m": 0.001, "motion.odometry_sigma": [0.02, 0.02, 0.02]}
    write_params(tmp_path / "params.yaml", params)
    out = tmp_path / "out"
    files = ["--markers", str(tmp_path / "markers.yaml"), "--route", str(tmp_path / "route.yaml")]
    files += ["--params", str(tmp_path / "params.yaml")]
    # fmt: off
    flags = ["--seeds", "2", "--seed", "3", "--selector", "lowest-reprojection", "--no-blur",
             "--no-rolling-shutter", "--corner-noise-px", "0.05", "--headless"]
    # fmt: on
    assert main(["demo", "--out", str(out), *files, *flags]) == 0
    together = json.loads((out / "summary.json").read_text())
    assert together["runs"] == 2
    for name, one in together["methods"].items():
        drives = [seed["drives"][name] for seed in together["seeds"]]
        assert one["reached"] == sum(drive["reached"] for drive in drives)
        assert one["position_rmse_m"] == np.median([d["position_rmse_m"] for d in drives])
    assert together["methods"]["our_method"]["reached"] == 2
    assert together["methods"]["our_method"]["success_rate"] == 1
    assert [seed["seed"] for seed in together["seeds"]] == [3, 4]
    for seed in (3, 4):
        assert (out / f"seed_{seed}" / "report.png").exists()
    assert together["seeds"][0]["params"] == str(tmp_path / "params.yaml")
    told = capsys.readouterr().out
    assert told.startswith(f"2 parameters from {tmp_path / 'params.yaml'}\n")
    assert "our method: reached all waypoints in 2 of 2 drives; " in told
    count = together["methods"]["opencv_first_pose"]["reached"]
    assert f"OpenCV, first pose: reached all waypoints in {count} of 2 drives; " in told


def test_counts_and_medians_of_several_seeds():
    def drive(reached: bool, error_m: float, worst_m: float) -> dict[str, Any]:
        return {"reached": reached, "position_rmse_m": error_m, "position_worst_m": worst_m}

    def seed(ours: dict[str, Any], opencv: dict[str, Any]) -> dict[str, Any]:
        drives = {"our_method": ours, "opencv_first_pose": opencv}
        return {"drives": drives, "alongside": {"position_rmse_m": opencv["position_rmse_m"] * 2}}

    fine = drive(True, 0.01, 0.02)
    together = overall(
        [seed(fine, drive(True, 0.1, 0.9)), seed(fine, drive(False, 0.9, 1.1)), seed(fine, fine)]
    )
    ours, opencv = together["methods"]["our_method"], together["methods"]["opencv_first_pose"]
    assert (ours["reached"], ours["success_rate"], ours["once_lost"]) == (3, 1.0, 0)
    assert (opencv["reached"], opencv["once_lost"]) == (2, 1)
    assert opencv["success_rate"] == pytest.approx(2 / 3)
    assert opencv["position_rmse_m"] == 0.1
    assert together["alongside"]["position_rmse_m"] == 0.2
    assert overall_lines(together)[1] == (
        "OpenCV, first pose: reached all waypoints in 2 of 3 drives; median position RMSE 0.100 m; "
        "once more than 1 m off in 1"
    )


def picture(side_px: float) -> np.ndarray:
    """Marker 0 of tag36h11 on grey, blurred, its corners at 60 and 60 + `side_px`."""
    cells = np.pad(marker_cells("tag36h11", 0), 1, constant_values=1.0)
    scale = side_px / 8
    to_px = np.array([[scale, 0, 60 - scale], [0, scale, 60 - scale]])
    big = np.kron(cells, np.ones((20, 20))).astype(np.float32)
    shrink = to_px @ np.array([[1 / 20, 0, 1 / 40], [0, 1 / 20, 1 / 40], [0, 0, 1]])
    image = cv2.warpAffine(big, shrink, (200, 160), flags=cv2.INTER_AREA, borderValue=0.6)
    return np.round(30 + 180 * cv2.GaussianBlur(image, (0, 0), 1.0)).astype(np.uint8)


def test_corners_are_opencv_s_in_our_order_with_the_told_sigma():
    assert not len(OpenCVDetector("tag36h11").detect(np.full((120, 160), 90, np.uint8)))
    found = OpenCVDetector("tag36h11").detect(picture(48.0))
    assert found.ids.tolist() == [0]
    assert found.families == ("tag36h11",)
    expected = 60 + 24 * (1 + CORNER_SIGNS[:, :2] * [1, -1])
    np.testing.assert_allclose(found.corners_px[0], expected, atol=1.0)
    np.testing.assert_array_equal(found.sigma_px, np.full((1, 4), OPENCV_SIGMA_PX))
    usual = cv2.aruco.DetectorParameters()
    usual.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_SUBPIX
    codes = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_APRILTAG_36h11)
    corners, _, _ = cv2.aruco.ArucoDetector(codes, usual).detectMarkers(picture(48.0))
    np.testing.assert_array_equal(found.corners_px[0], corners[0][0])


def opencv_s_poses(rig: CameraRig, markers: MarkerMap, corners_px: np.ndarray) -> list[SE3]:
    """Both poses T_vehicle_world of marker 0 in the front camera, OpenCV's first one first."""
    camera = rig.camera(0)
    (fx, fy), (cx, cy) = np.asarray(camera.focal_px), np.asarray(camera.center_px)
    K = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])
    flat = cv2.fisheye.undistortPoints(corners_px.reshape(1, 4, 2), K, np.zeros(4))
    half_m = float(markers.size_m[0]) / 2
    _, turns, places_m, errors = cv2.solvePnPGeneric(
        half_m * CORNER_SIGNS, flat[0], np.eye(3), None, flags=cv2.SOLVEPNP_IPPE_SQUARE
    )
    assert errors[0] <= errors[1]
    T_marker_world = SE3(markers.Ts_world_marker.wxyz_xyz[0]).inverse()
    T_vehicle_camera = SE3(rig.Ts_camera_vehicle.wxyz_xyz[0]).inverse()
    return [
        T_vehicle_camera
        @ SE3.from_rotation_and_translation(SO3.exp(turn.ravel()), place_m.ravel())
        @ T_marker_world
        for turn, place_m in zip(turns, places_m, strict=True)
    ]


@pytest.mark.long
def test_the_pose_taken_is_the_first_of_solve_pnp_generic():
    """Of 60 frames with noise it is another one only where both fit about alike."""
    rig, markers = load_rig(QCAR / "rig.yaml"), load_markers(QCAR / "markers.yaml")
    navigator = Navigator(
        rig=rig,
        markers=markers,
        vehicle=load_vehicle(QCAR / "vehicle.yaml"),
        waypoints_m=((1.3, 0.0),),
        selector=make_selector(OPENCV_SELECTOR),
    )
    step, rng = jax.jit(navigator.step), np.random.default_rng(0)
    same = wrong = 0
    for _ in range(60):
        distance_m, aside_rad, turn_rad = rng.uniform([2.0, -0.6, -0.4], [3.5, 0.6, 0.4])
        x_m, y_m = distance_m * np.sin(aside_rad), 1.47 - distance_m * np.cos(aside_rad)
        pose = jnp.array([x_m, y_m, np.arctan2(1.47 - y_m, -x_m) + turn_rad])
        T_vehicle_world = T_world_vehicle_from_planar(pose).inverse()
        corners_px = np.asarray(rig.project(T_vehicle_world, markers.corners_world_m)).copy()
        corners_px[0, 0] += OPENCV_SIGMA_PX * rng.standard_normal((4, 2))
        visible = jnp.zeros((4, 1), bool).at[0, 0].set(True)
        seen = Observation(
            corners_px=jnp.asarray(corners_px),
            visible=visible,
            dt_s=jnp.asarray(0.0),
            corner_sigma_px=jnp.full((4, 1, 4), OPENCV_SIGMA_PX),
        )
        _, out = step(navigator.init(), seen)
        taken = SE3(out.candidates.T_vehicle_world.wxyz_xyz[out.selected])
        first, second = opencv_s_poses(rig, markers, np.asarray(corners_px[0, 0], float))
        same += _apart_rad(taken, first) < _apart_rad(taken, second)
        wrong += _apart_rad(first, T_vehicle_world) > _apart_rad(second, T_vehicle_world)
    assert same >= 57
    assert wrong >= 5  # the choice is not an easy one


def _apart_rad(a: SE3, b: SE3) -> float:
    return float(jnp.linalg.norm((a.rotation().inverse() @ b.rotation()).log()))
