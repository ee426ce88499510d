"""`jaxnav demo`: two methods that drive from images, and the files it leaves."""

import json
from typing import Any

import cv2
import numpy as np
import pytest

from jaxnav.cli import main
from jaxnav.commands.simulate.demo import OPENCV_SIGMA_PX, overall, overall_lines
from jaxnav.commands.simulate.rendered_world import RenderedWorld
from jaxnav.core.navigator import Navigator
from jaxnav.files import calib_dir, write_params

QCAR = calib_dir() / "qcar"
TRAJECTORIES = (
    "our_method",
    "our_method_truth",
    "opencv_first_pose",
    "opencv_first_pose_truth",
    "opencv_first_pose_alongside",
)


@pytest.fixture(autouse=True)
def keep_the_compile_cache(monkeypatch):
    """Commands choose a cache of their own; tests keep theirs."""
    monkeypatch.setenv("JAX_COMPILATION_CACHE_DIR", "kept")


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


@pytest.mark.parametrize(
    ("flags", "message"),
    [
        (["--rig", "missing.yaml"], "missing.yaml"),
        (["--markers", "{qcar}/rig.yaml"], "rig.yaml"),
        (["--vehicle", "{tmp}/vehicle.yaml"], "vehicle.yaml: wheelbase_m"),
        (["--params", "missing.yaml"], "missing.yaml"),
        (["--params", "{tmp}/params.yaml"], "parameters.motion.vision_floor: must have 3 entries"),
        (["--exposure-ms", "60"], "--exposure-ms: the last row would be read after"),
        (["--out", "{tmp}/vehicle.yaml"], "is a file, not a folder"),
    ],
)
def test_bad_input_is_one_line_and_exit_code_2(tmp_path, capsys, flags, message):
    vehicle = (QCAR / "vehicle.yaml").read_text().replace("wheelbase_m: 0.256", "wheelbase_m: -1")
    (tmp_path / "vehicle.yaml").write_text(vehicle)
    write_params(tmp_path / "params.yaml", {"motion.vision_floor": [1] * 6})
    out = [] if "--out" in flags else ["--out", str(tmp_path / "out")]
    code = main(["demo", *(flag.format(tmp=tmp_path, qcar=QCAR) for flag in flags), *out])
    error = capsys.readouterr().err
    assert code == 2
    assert len(error.strip().splitlines()) == 1
    assert message in error
    assert not (tmp_path / "out").exists()


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
