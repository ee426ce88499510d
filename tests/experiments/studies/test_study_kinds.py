"""Studies of single frames and of drives: their counts against OpenCV and against `simulate`; and
the command, killed and continued, on other devices and on workers, gives the same bits."""

import os
import subprocess
import sys
import time
from pathlib import Path

import cv2
import jax
import numpy as np
import pytest
import xarray as xr

from jaxnav.cli import main
from jaxnav.commands.study.study import load_study, shipped_configs
from jaxnav.core.filter.selectors import SELECTORS
from jaxnav.core.models.imu import GYROS
from jaxnav.core.models.markers import CORNER_SIGNS
from jaxnav.core.models.vehicle import TwistBase, Vehicle
from jaxnav.errors import BadInput
from jaxnav.experiments.studies import lanes
from jaxnav.experiments.studies.ambiguity import FLIPPED, INVALID, RIGHT, SCHEMA, UNSEEN
from jaxnav.experiments.studies.drives import DriveStudy
from jaxnav.experiments.studies.running import run_here
from jaxnav.experiments.studies.store import BoxLayout, StudyStore, open_store
from jaxnav.experiments.studies.summary import summarise
from jaxnav.sim.rollout import Rollout
from jaxnav.sim.scenarios import on_laps, scenarios
from jaxnav.sim.scores import Drives

TRIALS = 400
CONFIG = f"""
trials: {TRIALS}
axes:
  range_m: [1.0, 2.5, 8.0]
  prior_angle_sigma_deg: [3.0, 90.0]
  selector: [lowest-reprojection, ratio-test, paper-cost, oracle]
fixed:
  view_angle_deg: 25
  corner_noise_px: 0.6
  prior_position_sigma_m: 0.05
"""
SIZE_M, FOCAL_PX, CENTER_PX = 0.172, 320.0, 1023.5


@pytest.fixture(scope="module")
def frames(tmp_path_factory: pytest.TempPathFactory) -> tuple[xr.Dataset, xr.Dataset]:
    """The trials and the summary of one study, in batches that leave a remainder."""
    folder = tmp_path_factory.mktemp("frames")
    (folder / "study.yaml").write_text(CONFIG)
    study = load_study("ambiguity", folder / "study.yaml")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(lanes, "BATCH", 512)
        store = open_store(folder / "s.zarr", study, 900)
        run_here(study, store)
    trials = store.dataset()
    return trials, summarise(trials, study.config, store.layout)


def opencv_flip_rate(range_m: float, noise_px: float, count: int) -> tuple[float, int]:
    """How often the better of OpenCV's two refined poses is the mirrored one, and of how many."""
    rng = np.random.default_rng(0)
    K = np.array([[FOCAL_PX, 0, CENTER_PX], [0, FOCAL_PX, CENTER_PX], [0, 0, 1]])
    lean = cv2.Rodrigues(np.deg2rad(25.0) * np.array([0.0, 1.0, 0.0]))[0]
    R_true = np.diag([1.0, -1.0, -1.0]) @ lean
    points = SIZE_M / 2 * CORNER_SIGNS
    exact = cv2.projectPoints(points, R_true, np.array([0, 0, range_m]), K, None)[0][:, 0]
    flipped = told = 0
    for _ in range(count):
        pixels = exact + rng.normal(scale=noise_px, size=exact.shape)
        _, turns, shifts, _ = cv2.solvePnPGeneric(
            points, pixels, K, None, flags=cv2.SOLVEPNP_IPPE_SQUARE
        )
        errors, angles = [], []
        for turn, shift in zip(turns, shifts, strict=True):
            turn, shift = cv2.solvePnPRefineLM(points, pixels, K, None, turn, shift)
            seen = cv2.projectPoints(points, turn, shift, K, None)[0][:, 0]
            errors.append(np.sum((seen - pixels) ** 2))
            cosine = (np.trace(R_true.T @ cv2.Rodrigues(turn)[0]) - 1) / 2
            angles.append(np.arccos(np.clip(cosine, -1, 1)))
        if min(angles) <= np.deg2rad(10):
            told += 1
            flipped += int(np.argmin(errors) != np.argmin(angles))
    return flipped / told, told


@pytest.mark.parametrize("range_m", [1.0, 2.5])
def test_markers_flip_as_often_as_opencv_says(
    frames: tuple[xr.Dataset, xr.Dataset], range_m: float
) -> None:
    _, summary = frames
    at = {"range_m": range_m, "prior_angle_sigma_deg": 90.0, "selector": "lowest-reprojection"}
    rate, told = opencv_flip_rate(range_m, 0.6, 1500)
    ours, count = summary["flip_rate"].sel(at).item(), TRIALS
    sigma = np.sqrt(rate * (1 - rate) * (1 / told + 1 / count)) + 1 / count
    assert abs(ours - rate) < 3.5 * sigma
    assert (rate > 0.1) == (range_m > 2)


def test_a_gate_is_a_matter_of_drives_alone() -> None:
    """Of single frames an ungated rule would be the rule itself."""
    ungated = {"lowest-reprojection-ungated", "paper-cost-ungated"}
    of_frames, of_drives = (
        set(schema.parameters["selector"].choices) for schema in (SCHEMA, DriveStudy.schema)
    )
    assert of_drives == set(SELECTORS)
    assert of_drives - of_frames == ungated | {"orientation-given"}


def test_selectors_are_told_apart(frames: tuple[xr.Dataset, xr.Dataset]) -> None:
    trials, summary = frames
    far = summary.sel(range_m=2.5)
    rate = far["flip_rate"]
    assert np.all(rate.sel(selector="oracle") == 0)
    # The ratio test answers less often and is wrong less often; e2 needs a good prediction.
    assert np.all(rate.sel(selector="ratio-test") < rate.sel(selector="lowest-reprojection"))
    assert np.all(far["declined_rate"].sel(selector="ratio-test") > 0.3)
    paper = rate.sel(selector="paper-cost")
    assert paper.sel(prior_angle_sigma_deg=3) < 0.05 < paper.sel(prior_angle_sigma_deg=90)
    # The frames are the same ones, whatever the selector and the prediction.
    lowest = trials["outcome"].sel(selector="lowest-reprojection")
    assert np.array_equal(*lowest.transpose("prior_angle_sigma_deg", ...).values)
    mirrored = trials["outcome"].sel(selector="lowest-reprojection") == FLIPPED
    angle = trials["rotation_error_deg"].sel(selector="lowest-reprojection").where(mirrored)
    assert 30 < angle.sel(range_m=2.5).median() < 70  # twice the viewing angle


def test_the_covariance_of_a_near_marker_is_consistent(
    frames: tuple[xr.Dataset, xr.Dataset],
) -> None:
    _, summary = frames
    near = summary.sel(range_m=1.0, prior_angle_sigma_deg=3.0, selector="oracle")
    assert 5.5 < near["nees_mean"] < 8.0
    assert near["position_error_m_median"] < near["position_error_m_p95"] < 0.5
    assert 1 <= near["lm_steps_median"] <= 12


def test_what_is_not_seen_is_counted_and_not_averaged(
    frames: tuple[xr.Dataset, xr.Dataset],
) -> None:
    trials, summary = frames
    far = trials.sel(range_m=8.0)  # 6.9 px: nobody reads it
    assert np.all(far["outcome"] == UNSEEN)
    assert np.all(np.isnan(far["position_error_m"]))
    counts = summary["outcome_count"].sel(range_m=8.0)
    assert np.all(counts.sel(outcome="unseen") == TRIALS)
    assert np.all(np.isnan(summary["flip_rate"].sel(range_m=8.0)))
    assert np.all(summary["position_error_m_counted"].sel(range_m=8.0) == 0)


def test_a_lane_that_overflows_is_counted(tmp_path: Path) -> None:
    (tmp_path / "s.yaml").write_text("trials: 8\naxes: {corner_noise_px: [0.5, 1.0e+30]}\n")
    study = load_study("ambiguity", tmp_path / "s.yaml")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(lanes, "BATCH", 16)
        store = open_store(tmp_path / "s.zarr", study)
        run_here(study, store)
    trials = store.dataset()
    outcome = trials["outcome"].values
    assert np.all(outcome[1] == INVALID)
    assert set(outcome[0]) <= {RIGHT, FLIPPED}
    summary = summarise(trials, study.config, store.layout)
    assert list(summary["invalid_rate"].values) == [0, 1]
    assert summary["position_error_m_counted"].values[0] == 8
    assert np.isfinite(summary["position_error_m_median"].values[0])


@pytest.mark.long
def test_drives_are_those_of_simulate(tmp_path: Path) -> None:
    (tmp_path / "s.yaml").write_text(
        "trials: 6\nseed: 3\naxes: {corner_noise_px: [0.3, 1.0]}\n"
        "fixed: {selector: paper-cost, duration_s: 1.4}\n"
    )
    study = load_study("drive", tmp_path / "s.yaml")
    assert isinstance(study, DriveStudy)
    cells = [study.config.cell((0,)), study.config.cell((1,))]
    found = study.run(cells, range(6))
    told: list[int] = []
    part = study.run(cells[1:], range(2, 5), told.append)
    assert sum(told) == 3  # and not the six lanes
    told.clear()
    run_here(study, open_store(tmp_path / "s.zarr", study), told.append)  # both cells in one box
    assert sum(told) == 12
    assert max(told) <= 6
    for name, values in found.items():
        assert values.shape == (2, 6)
        np.testing.assert_array_equal(part[name][0], values[1, 2:5], err_msg=name)
    with jax.enable_x64(False):
        scenario = study.scenario(cells[1])
        key = jax.random.key(3)
        keys = jax.vmap(lambda trial: jax.random.fold_in(key, trial))(np.arange(6))
        rollout = study.rollout(cells[1], scenario)
        assert isinstance(rollout, Rollout)
        drives = Drives.from_trace(rollout.run(keys), scenario)
    np.testing.assert_allclose(found["duration_s"][1], drives.duration_s, rtol=1e-6)
    decided = [e[d] for e, d in zip(drives.position_error_m, drives.decided, strict=True)]
    medians = [np.median(e) if len(e) else np.nan for e in decided]
    np.testing.assert_allclose(found["position_error_m"][1], medians, rtol=1e-5)


def test_a_drive_study_varies_errors_that_repeat(tmp_path: Path) -> None:
    (tmp_path / "s.yaml").write_text(
        "trials: 2\naxes: {scenario: [paper, everything]}\n"
        "fixed: {corner_drift_px: 0.7, corner_correlation: 1, corner_lag_s: 0.06, wheel_spin: 0.2,"
        " wheel_spin_from_s: 0,"
        " cameras_off_deg: 2, steering_offset_deg: -3, laps: 2}\n"
    )
    study = load_study("drive", tmp_path / "s.yaml")
    assert isinstance(study, DriveStudy)
    for index, name in enumerate(("paper", "everything")):
        cell, usual = study.config.cell((index,)), scenarios()[name]
        scenario = study.scenario(cell)
        assert scenario.waypoints_m == on_laps(usual, 2).waypoints_m
        assert (scenario.corner_correlation, scenario.corner_lag_s) == (1, 0.06)
        assert scenario.extrinsics_off == pytest.approx((np.deg2rad(2), usual.extrinsics_off[1]))
        odometry = scenario.odometry
        assert (odometry.spin, odometry.spin_from_s) == (0.2, 0)
        assert odometry.speed_scale == usual.odometry.speed_scale
        assert odometry.steering_offset_rad == pytest.approx(np.deg2rad(-3))
        assert scenario.corner_drift_px == pytest.approx(0.7)
    (tmp_path / "s.yaml").write_text("trials: 2\naxes: {corner_lag_s: [0.05, 0.1]}\n")
    with pytest.raises(BadInput, match=r"axes\.corner_lag_s\[1\]: must be >= 0 and <= 0\.0666"):
        load_study("drive", tmp_path / "s.yaml")
    (tmp_path / "s.yaml").write_text("trials: 2\naxes: {scenario: [drifting-corners]}\n")
    own = load_study("drive", tmp_path / "s.yaml")
    assert isinstance(own, DriveStudy)
    cell = own.config.cell((0,))
    assert own.scenario(cell).corner_drift_px == 0.5


def test_a_drive_study_varies_what_drives_and_its_gyro(tmp_path: Path) -> None:
    (tmp_path / "s.yaml").write_text(
        "trials: 2\naxes: {base: [ackermann, omni]}\nfixed: {imu: tactical}\n"
    )
    study = load_study("drive", tmp_path / "s.yaml")
    assert isinstance(study, DriveStudy)
    car, omni = (
        study.rollout(cell, study.scenario(cell))
        for cell in (study.config.cell((index,)) for index in range(2))
    )
    assert isinstance(car.vehicle, Vehicle)
    assert isinstance(omni.vehicle, TwistBase)
    for rollout in (car, omni):
        assert rollout.vehicle.gyro == GYROS["tactical"]
        assert rollout.navigator.controller.vehicle is rollout.vehicle
    (tmp_path / "s.yaml").write_text("trials: 2\naxes: {base: [boat]}\n")
    with pytest.raises(BadInput, match=r"axes\.base\[0\]: unknown 'boat'"):
        load_study("drive", tmp_path / "s.yaml")


def command(*args: object, **environment: str) -> "subprocess.Popen[str]":
    """`jaxnav` in a process of its own."""
    words = [sys.executable, "-c", "import sys; from jaxnav.cli import main; sys.exit(main())"]
    return subprocess.Popen(
        [*words, *map(str, args)],
        env={**os.environ, **environment},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )


def finished(process: "subprocess.Popen[str]", code: int = 0) -> str:
    out, err = process.communicate(timeout=240)
    assert process.returncode == code, err
    return out


@pytest.mark.long
def test_killed_continued_elsewhere_the_bits_stay_the_same(
    frames: tuple[xr.Dataset, xr.Dataset], tmp_path: Path
) -> None:
    """Killed half way, on two devices, in other boxes and batches than the whole."""
    whole, _ = frames
    (tmp_path / "study.yaml").write_text(CONFIG)
    study = ["study", "ambiguity", tmp_path / "study.yaml", "--headless", "--out"]
    two = {
        "XDG_CACHE_HOME": str(tmp_path / "cache"),
        "XLA_FLAGS": os.environ.get("XLA_FLAGS", "") + " --xla_force_host_platform_device_count=2",
    }
    parts, total = tmp_path / "parts.zarr", 6 * TRIALS
    process = command(*study, parts, "--chunk-trials", 200, **two)
    while not parts.exists() or StudyStore(parts).count_done() < 200:
        assert process.poll() is None, process.communicate()
        time.sleep(0.02)
    process.kill()
    process.communicate()
    assert 200 <= StudyStore(parts).count_done() < total
    out = finished(command(*study, parts, **two))
    assert f"of {total} trials: going on" in out
    xr.testing.assert_identical(StudyStore(parts).dataset(), whole)


def test_an_interrupted_study_says_how_to_go_on(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def interrupted(*_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("jaxnav.commands.study.study.configure_jax", lambda float64: None)
    monkeypatch.setattr("jaxnav.commands.study.study.run_here", interrupted)
    (tmp_path / "s.yaml").write_text("trials: 5\naxes: {range_m: [1]}\n")
    out = tmp_path / "s.zarr"
    command = ["study", "ambiguity", str(tmp_path / "s.yaml"), "--out", str(out), "--headless"]
    assert main(command) == 130
    assert f"0 of 5 trials are in {out}; the same command goes on" in capsys.readouterr().out


def test_a_study_is_drawn(
    frames: tuple[xr.Dataset, xr.Dataset], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    import matplotlib.image

    (tmp_path / "s.yaml").write_text(
        "trials: 5\naxes: {range_m: [1, 2, 3], corner_noise_px: [0.1, 0.5, 1.0]}\n"
    )
    store = open_store(tmp_path / "s.zarr", load_study("ambiguity", tmp_path / "s.yaml"), 15)
    assert main(["plot", str(store.path), "--headless"]) == 2
    assert "holds no trial yet" in capsys.readouterr().err
    shape = dict.fromkeys(SCHEMA.variables, (3, 5))
    for number, box in enumerate(list(store.missing())[:2]):
        found = {
            n: np.full(shape[n], number, variable.dtype) for n, variable in SCHEMA.variables.items()
        }
        store.write(box, found)
    assert main(["plot", str(store.path), "--headless", "--out", str(tmp_path / "out")]) == 0
    assert "holds 30 of 45 trials so far" in capsys.readouterr().out
    pictures = sorted(path.name for path in (tmp_path / "out").glob("*.png"))
    assert "map_flip_rate.png" in pictures
    assert "reliability.png" in pictures
    assert sum(name.startswith("curves") for name in pictures) >= 1
    image = matplotlib.image.imread(tmp_path / "out" / "map_flip_rate.png")[..., :3]
    assert len(np.unique(image.reshape(-1, 3), axis=0)) > 50


@pytest.mark.parametrize("kind", ["ambiguity", "drive"])
def test_the_shipped_configs_are_studies(kind: str, capsys: pytest.CaptureFixture[str]) -> None:
    names = shipped_configs(kind)
    assert len(names) >= 2
    for name in names:
        study = load_study(kind, Path(name))
        assert BoxLayout.from_shape(study.config.shape, 100).trials > 1000
    assert main(["study", kind, "list"]) == 0
    out = capsys.readouterr().out
    assert all(name in out for name in [*names, *study.schema.parameters])


def test_a_rig_has_as_many_cameras_as_it_has(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("jaxnav.commands.study.study.configure_jax", lambda float64: None)
    (tmp_path / "s.yaml").write_text("trials: 1\nrig: qcar\naxes: {cameras: [1, 5]}\n")
    assert main(["study", "ambiguity", str(tmp_path / "s.yaml")]) == 2
