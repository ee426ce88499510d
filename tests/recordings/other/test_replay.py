"""Real four-camera recordings through the estimator, against TagSLAM's bundle adjustment."""

import csv
import dataclasses
import json

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from jaxnav.cli import main
from jaxnav.core.filter.choose import LowestReprojection, PaperCost
from jaxnav.core.filter.free import ConstantVelocity
from jaxnav.core.filter.hypotheses import MultiHypothesis
from jaxnav.core.navigator import Navigator
from jaxnav.core.pose.observation import Observation
from jaxnav.files import write_params
from jaxnav.recordings.other import localise
from jaxnav.recordings.other.localise import CHUNK_FRAMES, filter_frames, smooth_frames
from jaxnav.recordings.other.recordings import Recording, read_recording
from jaxnav.recordings.other.replay import (
    Replay,
    errors,
    explain_outliers,
    frames_in_view,
    replay,
)
from jaxnav.recordings.ros.odometry_track import OdometryTrack
from tests.helpers.compiling import jit_to_run


@pytest.fixture(scope="module")
def test_7(data_dir) -> Recording:
    return read_recording(data_dir / "tagslam" / "test_7" / "decoded.npz")


@pytest.fixture(scope="module")
def alone(test_7) -> Replay:
    """Every marker by itself, by the lowest reprojection error."""
    return replay(test_7, LowestReprojection(), one_at_a_time=True)


@pytest.fixture(autouse=True)
def keep_the_compile_cache(monkeypatch):
    """Commands choose a cache of their own; tests keep theirs."""
    monkeypatch.setenv("JAX_COMPILATION_CACHE_DIR", "kept")


@pytest.fixture
def run_banks_fast(monkeypatch):
    """A bank takes longer over a whole recording than to be optimised."""
    fast = jit_to_run(filter_frames.__wrapped__, static_argnames=("alone", "keep"))
    monkeypatch.setattr(localise, "filter_frames", fast)
    monkeypatch.setattr(localise, "smooth_frames", jit_to_run(smooth_frames.__wrapped__))


@pytest.mark.long
@pytest.mark.parametrize(
    ("name", "frames", "selector", "median_m", "p95_m"),
    [
        ("test_5", 1200, "lowest-reprojection", 0.0029, 0.0125),  # of 2751
        ("test_7", 454, "multi-hypothesis", 0.0015, 0.0041),  # all of it
    ],
)
def test_all_markers_locate_the_rig_to_millimetres(
    data_dir, tmp_path, capsys, run_banks_fast, name, frames, selector, median_m, p95_m
):
    folder = data_dir / "tagslam" / name
    arguments = ["replay", str(folder), "--selector", selector, "--out", str(tmp_path)]
    code = main([*arguments, "--limit", str(frames), "--headless"])
    assert code == 0
    summary = json.loads((tmp_path / "summary.json").read_text())
    assert summary["position_error_m"]["median"] <= median_m
    assert summary["position_error_m"]["p95"] <= p95_m
    assert summary["rotation_error_deg"]["median"] <= 0.06
    assert summary["wrong_branch_fraction"] == 0
    assert summary["outlier_fraction"] < 0.01
    assert summary["frames"] == frames
    assert summary["frames_per_second"] > 0
    assert (tmp_path / "report.png").read_bytes().startswith(b"\x89PNG")
    rows = np.loadtxt(tmp_path / "trajectory.tum")
    assert rows.shape == (summary["frames_located"], 8)
    np.testing.assert_allclose(np.linalg.norm(rows[:, 4:], axis=1), 1, atol=1e-6)
    assert "wrong branch 0.00%" in capsys.readouterr().out


def test_one_marker_at_a_time_takes_few_wrong_branches(test_7, alone):
    result = alone
    judged = result.seen & test_7.reference.valid[:, None]
    assert judged.sum() > 2600
    np.testing.assert_array_equal(result.seen, test_7.visible.any(axis=1))
    assert (result.branch.wrong & judged).sum() / judged.sum() <= 0.006
    assert (result.branch.outlier & judged).sum() / judged.sum() <= 0.004
    position_m, rotation_deg = errors(result, test_7)
    assert np.nanmedian(position_m) < 0.0105
    assert np.nanmedian(rotation_deg) < 0.52


@pytest.mark.long
def test_the_bank_halves_the_wrong_branches_and_smoothing_decides_the_others(
    test_7, alone, run_banks_fast
):
    """Every marker by itself, no odometry, every detection judged that has two poses or one."""
    smooth = replay(test_7, MultiHypothesis(), one_at_a_time=True, smooth=True)
    bank, wrong = smooth.filtered, []
    for result in (alone, bank, smooth):
        judged = result.seen & test_7.reference.valid[:, None]
        wrong.append(int((result.branch.wrong & judged).sum()))
        assert np.all(result.located[judged])
    assert wrong[0] >= 5
    assert wrong[1] <= wrong[0] / 2
    # What was open at first is decided by what follows.
    np.testing.assert_array_equal(smooth.seen, bank.seen)
    undecided = [int((result.seen & ~result.decided).sum()) for result in (bank, smooth)]
    assert wrong[2] <= wrong[1]
    assert undecided[0] >= 20
    assert undecided[1] <= undecided[0] / 4
    error_m = [errors(result, test_7)[0] for result in (bank, smooth)]
    percentile_m = [np.nanpercentile(error, 95) for error in error_m]
    assert percentile_m[1] < 0.95 * percentile_m[0]
    # The last pose of a marker is told no more than before.
    last = len(test_7) - 1 - np.argmax(smooth.located[::-1], axis=0)
    for track in np.flatnonzero(smooth.located.any(axis=0)):
        pose = smooth.T_world_vehicle[last[track], track], bank.T_world_vehicle[last[track], track]
        np.testing.assert_allclose(*pose, atol=1e-12)


@pytest.mark.long
def test_poses_between_two_sightings_are_smoothed(test_7):
    """Where no marker is seen for a while, the track goes on, and ends where the next one says."""
    few, gap = test_7.first(64), slice(40, 43)
    hides = (few.seen_at[0] >= gap.start) & (few.seen_at[0] < gap.stop)
    hidden = dataclasses.replace(few, seen_at=few.seen_at[:, ~hides], seen_px=few.seen_px[~hides])
    result = replay(hidden, LowestReprojection(), corner_sigma_px=1.0, smooth=True)
    assert result.filtered.located[gap].all()
    assert not result.seen[gap].any()
    reference_m = few.reference.T_world_vehicle[gap, 4:]
    filtered_m, smooth_m = (
        np.linalg.norm(one.T_world_vehicle[gap, 0, 4:] - reference_m, axis=1)
        for one in (result.filtered, result)
    )
    assert smooth_m.max() < filtered_m.max() / 3


def test_frames_in_view_are_counted_from_every_appearance():
    seen = np.array([[1, 0], [1, 1], [0, 1], [1, 1], [1, 0], [1, 1]], bool)
    counts = [[1, 0], [2, 1], [0, 2], [1, 3], [2, 0], [3, 1]]
    np.testing.assert_array_equal(frames_in_view(seen), counts)
    assert frames_in_view(seen[:0]).shape == (0, 2)


@pytest.mark.long
def test_a_replay_is_the_step_over_and_over(test_7):
    # Not a whole number of chunks: padding must not show.
    short = test_7.first(CHUNK_FRAMES + 7)
    result = replay(short, PaperCost(), corner_sigma_px=1.0)
    navigator = Navigator(short.rig, short.markers, selector=PaperCost(), motion=ConstantVelocity())
    step, state = jax.jit(navigator.step), navigator.init()
    dt_s = np.diff(short.stamps_ns, prepend=short.stamps_ns[:1]) / 1e9
    for frame in range(len(short)):
        obs = Observation(
            jnp.asarray(short.corners_px[frame]),
            jnp.asarray(short.visible[frame]),
            dt_s=jnp.asarray(min(dt_s[frame], 1.0)),
        )
        state, out = step(state, obs)
        np.testing.assert_allclose(
            jaxlie.SE3(jnp.asarray(result.T_world_vehicle[frame, 0])).as_matrix(),
            out.T_world_vehicle.as_matrix(),
            atol=1e-9,
        )
    assert result.T_world_vehicle.shape == (CHUNK_FRAMES + 7, 1, 7)


@pytest.mark.long
def test_without_a_marker_the_pose_goes_on_by_the_odometry_alone(test_7):
    """Over 10 s, by an odometry in a frame of its own that turns 0.3 degrees a second too far."""
    begin, end = 60, 110
    T_world_vehicle = jaxlie.SE3(jnp.asarray(test_7.reference.T_world_vehicle[:end]))
    away_rad = np.deg2rad(0.3) * (test_7.stamps_ns[:end] - test_7.stamps_ns[0]) / 1e9
    turned = jnp.zeros((end, 6)).at[:, 5].set(away_rad).at[:, :3].set(1.0)
    odom = jaxlie.SE3.exp(turned) @ T_world_vehicle
    track = OdometryTrack(
        test_7.stamps_ns[:end], np.asarray(odom.wxyz_xyz), np.array([1.0, 0, 0, 0, 0, 0, 0])
    )
    kept = test_7.seen_at[0] < begin
    hidden = dataclasses.replace(
        test_7.first(end),
        odometry=track,
        seen_at=test_7.seen_at[:, kept],
        seen_px=test_7.seen_px[kept],
    )
    result = replay(hidden, LowestReprojection(), corner_sigma_px=1.0)
    poses = jaxlie.SE3(jnp.asarray(result.T_world_vehicle[:, 0]))
    last, over = (jaxlie.SE3(poses.wxyz_xyz[row]) for row in (begin - 1, end - 1))
    there, back = (jaxlie.SE3(odom.wxyz_xyz[row]) for row in (begin - 1, end - 1))
    expected = last @ there.inverse() @ back
    np.testing.assert_allclose(over.as_matrix(), expected.as_matrix(), atol=1e-8)
    assert result.located[-1, 0]
    assert not result.seen[-1, 0]
    # Without the odometry it would have been lost.
    truth = jaxlie.SE3(T_world_vehicle.wxyz_xyz[end - 1])
    assert np.linalg.norm((over.inverse() @ truth).translation()) < 0.2


@pytest.mark.long
def test_a_recording_without_a_reference_gives_a_track_and_no_errors(
    test_7, tmp_path, monkeypatch, capsys
):
    blind = dataclasses.replace(test_7.first(20), reference=None)
    monkeypatch.setattr("jaxnav.commands.drive.replay.read_recording", lambda *_: blind)
    command = ["replay", "whatever", "--selector", "lowest-reprojection", "--headless"]
    assert main([*command, "--out", str(tmp_path)]) == 0
    summary = json.loads((tmp_path / "summary.json").read_text())
    assert "position_error_m" not in summary
    assert summary["poses"] == 20
    assert "error" not in capsys.readouterr().out


@pytest.mark.long
def test_limit_and_one_at_a_time_on_the_command_line(data_dir, tmp_path):
    folder = str(data_dir / "tagslam" / "test_7")
    args = ["--one-at-a-time", "--selector", "lowest-reprojection", "--limit", "300"]
    assert main(["replay", folder, "--out", str(tmp_path), "--headless", *args]) == 0
    summary = json.loads((tmp_path / "summary.json").read_text())
    assert summary["frames"] == 300
    assert summary["poses"] > summary["frames_located"]
    # Of 1834 poses eight are wrong, seven of them after a marker's first five frames.
    wrong, settled = (summary[f"wrong_branch_fraction{of}"] for of in ("", "_after_5_frames"))
    assert 0 < settled < 0.01
    assert 0 < wrong < 0.01
    assert wrong != settled
    assert len(list(tmp_path.glob("trajectory_marker_*.tum"))) == 9
    # Who counts again by the lines of the detections finds the same.
    with (tmp_path / "detections.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert len(rows) >= summary["poses"]
    own = {(row["frame"], row["id"]): row for row in rows}.values()
    stamped = np.loadtxt(tmp_path / "reference.tum")
    counted = []
    for row in own:
        at = np.argmin(np.abs(stamped[:, 0] - int(row["stamp_ns"]) / 1e9))
        true = Rotation.from_quat(stamped[at, 4:])
        turns = {
            name: Rotation.from_quat([float(row[f"{name}_q{axis}"]) for axis in "xyzw"])
            for name in ("reported", *(f"candidate_{n}" for n in range(4)))
            if row.get(f"{name}_qw", "nan") != "nan"
        }
        off_deg = {
            name: np.rad2deg((true.inv() * turn).magnitude()) for name, turn in turns.items()
        }
        assert off_deg.pop("reported") == pytest.approx(float(row["rotation_error_deg"]), abs=1e-3)
        chosen, nearest = f"candidate_{row['chosen']}", min(off_deg, key=off_deg.get)
        apart_deg = np.rad2deg((turns[chosen].inv() * turns[nearest]).magnitude())
        counted.append(off_deg[nearest] <= 10 and apart_deg > 3)
        assert 0 <= float(row["view_deg"]) < 90
    assert np.mean(counted) == pytest.approx(wrong, abs=1e-9)


def test_what_makes_outliers_is_named(test_7):
    """Markers of the map that are elsewhere, or a reference in a frame of its own."""
    assert "agree with the corners" in explain_outliers(test_7)
    poses = np.array(test_7.markers.Ts_world_marker.wxyz_xyz)
    poses[2, 4:] += 0.3
    markers = dataclasses.replace(test_7.markers, Ts_world_marker=jaxlie.SE3(jnp.asarray(poses)))
    off = explain_outliers(dataclasses.replace(test_7, markers=markers))
    assert off.endswith(f"not where the map says, by the reference, are markers {markers.ids[2]}")
    elsewhere = np.array(test_7.reference.T_world_vehicle)
    elsewhere[:, 4] += 2.0
    reference = test_7.reference._replace(T_world_vehicle=elsewhere)
    said = explain_outliers(dataclasses.replace(test_7, reference=reference))
    assert "map and reference do not share a frame" in said


@pytest.mark.long
def test_parameters_go_before_what_the_recording_tells(test_7, tmp_path, monkeypatch, capsys):
    short = test_7.first(20)
    monkeypatch.setattr("jaxnav.commands.drive.replay.read_recording", lambda *_: short)
    values = {"corner_sigma_px": 3.0, "motion.vision_floor": [1.0] * 6, "controller.lookahead_m": 1}
    write_params(tmp_path / "p.yaml", values, {"loss": 0.5})
    command = ["replay", "whatever", "--selector", "lowest-reprojection", "--headless"]
    command += ["--out", str(tmp_path), "--params", str(tmp_path / "p.yaml")]
    tracks = []
    for flags, sigma_px in (([], 3.0), (["--corner-sigma-px", "2"], 2.0)):
        assert main([*command, *flags]) == 0
        summary = json.loads((tmp_path / "summary.json").read_text())
        assert summary["params"] == str(tmp_path / "p.yaml")
        assert summary["corner_sigma_px"] == sigma_px
        tracks.append(np.loadtxt(tmp_path / "trajectory.tum"))
    assert "(loss: 0.5)\n" in capsys.readouterr().out
    # A pose that measures nothing is followed late.
    own = replay(short, LowestReprojection(), corner_sigma_px=3.0)
    assert np.abs(tracks[0][-1, 1:4] - own.T_world_vehicle[-1, 0, 4:]).max() > 1e-4


def test_bad_input_is_one_line_and_exit_code_2(data_dir, tmp_path, capsys):
    (tmp_path / "x.txt").write_text("no recording")
    write_params(tmp_path / "p.yaml", {"motion.odometry_sigma": [1.0] * 3})  # of a car
    folder = data_dir / "tagslam" / "test_7"
    for args, message in [
        (["missing"], "missing: there is no such file or folder"),
        ([tmp_path / "x.txt"], "is no recording"),
        ([folder / "tag_detections.bag.bz2"], "--rig: missing"),
        ([folder, "--rig", "nowhere.yaml"], "nowhere.yaml"),
        ([folder, "--params", tmp_path / "p.yaml"], "odometry_sigma: this navigator has no such n"),
        ([folder, "--limit", "0"], "--limit: must be at least 1, got 0"),
        ([folder, "--selector", "none"], "--selector"),
    ]:
        assert main(["replay", *map(str, args), "--out", str(tmp_path / "out")]) == 2
        (line,) = capsys.readouterr().err.strip().splitlines()
        assert message in line
    assert not (tmp_path / "out").exists()
