"""`jaxnav demo`: the paper's experiment from images, and the files it leaves."""

import json

import cv2
import numpy as np
import pytest

from jaxnav.cli import main
from jaxnav.commands.simulate.rendered_world import RenderedWorld
from jaxnav.files import calib_dir, write_params
from jaxnav.navigator import Navigator

QCAR = calib_dir() / "qcar"


@pytest.fixture(autouse=True)
def keep_the_compile_cache(monkeypatch):
    """Commands choose a cache of their own; tests keep theirs."""
    monkeypatch.setenv("JAX_COMPILATION_CACHE_DIR", "kept")


def test_the_paper_experiment_from_images(tmp_path, capsys, monkeypatch):
    """Beside our method, on the same frames, the paper's as it is written."""
    made = {}

    def navigator(world: RenderedWorld, selector: str) -> Navigator:
        made[selector] = navigator_of(world, selector)
        return made[selector]

    navigator_of = RenderedWorld.navigator
    monkeypatch.setattr(RenderedWorld, "navigator", navigator)
    assert main(["demo", "--out", str(tmp_path), "--headless"]) == 0
    assert list(made) == ["multi-hypothesis", "lowest-reprojection-ungated"]
    assert [np.isfinite(one.motion.gate_nis) for one in made.values()] == [True, False]
    summary = json.loads((tmp_path / "summary.json").read_text())
    assert summary["reached"] is True
    assert summary["steps"] == pytest.approx(summary["duration_s"] * 15 + 1, abs=0.01)
    assert summary["marker_seen_fraction"] > 0.95
    assert set(summary["methods"]) == {"our_method", "method_a_kf"}
    ours = summary["methods"]["our_method"]
    assert ours["position_rmse_m"] < 0.05
    assert ours["yaw_rmse_deg"] < 2
    assert ours["wrong_branch_fraction"] < 0.05
    for name in ("truth", "our_method", "method_a_kf"):
        rows = np.loadtxt(tmp_path / f"{name}.tum")
        assert rows.shape[1] == 8
    # It ends inside the last waypoint's radius.
    truth = np.loadtxt(tmp_path / "truth.tum")
    assert np.linalg.norm(truth[-1, 1:3] - [0.5, 0.65]) < 0.2
    for picture in ("report.png", "mosaic.png"):
        assert cv2.imread(str(tmp_path / picture)).shape[1] > 800
    paper_s_m = summary["methods"]["method_a_kf"]["position_rmse_m"]
    line = capsys.readouterr().out
    assert "reached all waypoints" in line
    assert f"(the paper's Method A + KF {paper_s_m:.3f} m)" in line


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
    overall = json.loads((out / "summary.json").read_text())
    assert overall["runs"] == 2
    assert overall["reached"] == 2
    assert [drive["seed"] for drive in overall["drives"]] == [3, 4]
    for seed in (3, 4):
        assert (out / f"seed_{seed}" / "report.png").exists()
    assert overall["drives"][0]["params"] == str(tmp_path / "params.yaml")
    told = capsys.readouterr().out
    assert told.startswith(f"2 parameters from {tmp_path / 'params.yaml'}\n")
    assert "reached in 2 of 2 drives" in told


@pytest.mark.parametrize(
    ("flags", "message"),
    [
        (["--rig", "missing.yaml"], "missing.yaml"),
        (["--markers", "{qcar}/rig.yaml"], "rig.yaml"),
        (["--vehicle", "{tmp}/vehicle.yaml"], "vehicle.yaml: wheelbase_m"),
        (["--params", "missing.yaml"], "missing.yaml"),
        (["--params", "{tmp}/params.yaml"], "parameters.motion.vision_floor: must have 3 entries"),
        (["--exposure-ms", "60"], "--exposure-ms: the last row would be read after"),
        (["--exposure-ms", "-1"], "--exposure-ms"),
        (["--corner-noise-px", "nan"], "--corner-noise-px"),
        (["--seeds", "0"], "--seeds"),
        (["--selector", "best"], "--selector"),
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
