"""Far from the world's zero all results are as at zero, in float32 too."""

import dataclasses
import json
import math
from pathlib import Path
from unittest.mock import MagicMock

import jax
import numpy as np
import pytest
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st

from jaxnav.cli import main
from jaxnav.commands.drive.observers import WIDTH
from jaxnav.commands.drive.status_line import status_line
from jaxnav.commands.process import configure_jax
from jaxnav.core.models.origin import (
    GRID_M,
    NEAR_M,
    ZERO,
    inverses_in_world,
    opposite,
    origin_near,
    planar_in_world,
    poses_in_world,
)
from jaxnav.drive.flags import Health
from jaxnav.files import Route, calib_dir, load_markers, load_route, poses, save_markers, write_tum
from jaxnav.files.configuration import step_folder
from jaxnav.files.markers import MarkerFile, marker_map
from jaxnav.files.vehicles import RouteFile
from jaxnav.pictures.rerun.scene import RerunScene
from jaxnav.pictures.scenery import Scenery
from jaxnav.recordings.drive_log import read_drive
from jaxnav.recordings.drive_replay import Comparison, replay_drive
from jaxnav.recordings.drive_setup import DriveSetup
from jaxnav.recordings.records import Outcomes
from jaxnav.vehicles.conformance.faults import WAYPOINTS_M
from tests import worlds
from tests.helpers.simulated import record, simulated

QCAR = calib_dir() / "qcar"
FAR_M = (1e7, -1e7, 0.0)
UTM_M = (448_251.37, 5_411_932.81, 0.0)
EARTH_M = (448_251.37, -2e6, 4e6)  # as far up as earth-centred coordinates are
SHIFTS_M = (FAR_M, UTM_M, EARTH_M)
MM = 1e-3

far = st.floats(-1e8, 1e8)


def shifted_map(by_m) -> dict:
    """What a file of the paper's marker holds that counts from elsewhere."""
    data = yaml.safe_load((QCAR / "markers.yaml").read_text())
    for marker in data["markers"]:
        corners = np.array(marker.pop("corners_world_m"), float) + np.array(by_m)
        marker["corners_world_m"] = corners.tolist()
    return data


def shifted_setup(by_m, float64: bool) -> DriveSetup:
    route = Route(
        tuple((x + by_m[0], y + by_m[1]) for x, y in WAYPOINTS_M),
        0.15,
        (worlds.START_VIEW[0] + by_m[0], worlds.START_VIEW[1] + by_m[1], worlds.START_VIEW[2]),
    )
    markers = MarkerFile.model_validate(shifted_map(by_m)).map()
    return DriveSetup(worlds.qcar_rig(), markers, worlds.qcar(), route, float64=float64)


@given(st.lists(st.tuples(far, far, far), min_size=1, max_size=5))
def test_an_origin_is_round_and_near_or_zero(places_m):
    middle_m, origin_m = np.mean(places_m, axis=0), origin_near(np.array(places_m))
    for middle, origin in zip(middle_m, origin_m, strict=True):
        if abs(middle) <= NEAR_M:
            assert origin == 0
        else:
            assert abs(middle - origin) <= GRID_M / 2
            assert origin % GRID_M == 0


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_near_zero_not_a_bit_changes(dtype):
    Ts = np.random.default_rng(0).uniform(-999, 999, (3, 7)).astype(dtype)
    assert origin_near(Ts[:, 4:]) == ZERO
    for function in (poses_in_world, inverses_in_world):
        assert function(Ts, ZERO) is Ts
    assert planar_in_world(Ts[:, :3], ZERO).dtype == dtype
    assert opposite(ZERO) is ZERO
    route = Route(((1.0, -0.0),), 0.1, (0.3, 0.1, 7.0))
    assert route.relative_to(ZERO) == route
    assert worlds.paper_markers().origin_m == ZERO


@settings(max_examples=50)
@given(st.tuples(far, far, far), st.integers(0, 2**32 - 1))
def test_an_inverse_leads_where_its_pose_is(origin_m, seed):
    """Quaternions of float32 are not of length 1 by 1e-7, which is a metre at 10 000 km."""
    rng = np.random.default_rng(seed)
    quaternion = rng.standard_normal(4)
    T = np.concatenate([quaternion / np.linalg.norm(quaternion), rng.uniform(-50, 50, 3)])
    inverse = poses.inverse(T).astype(np.float32)
    there = poses.inverse(inverses_in_world(inverse[None], origin_m)[0].astype(float))
    expected = poses_in_world(poses.inverse(inverse.astype(float)), origin_m)
    # Some spacings of float64 at 1e8 m.
    np.testing.assert_allclose(there[4:], expected[4:], rtol=0, atol=1e-6)


@pytest.mark.parametrize("shift_m", SHIFTS_M)
@pytest.mark.parametrize("double", [False, True])
def test_a_far_map_keeps_its_digits(tmp_path, shift_m, double):
    path = tmp_path / "markers.yaml"
    path.write_text(yaml.safe_dump(shifted_map(shift_m)))
    with jax.enable_x64(double):
        markers = load_markers(path)
        here = np.asarray(markers.corners_world_m, float) + markers.origin_m - np.array(shift_m)
        there = np.asarray(worlds.paper_markers().corners_world_m)
        np.testing.assert_allclose(here, there, atol=0.01 * MM)
        save_markers(path, markers)
        again = load_markers(path)
        assert again.origin_m == markers.origin_m
        now, then = (np.asarray(one.Ts_world_marker.wxyz_xyz) for one in (again, markers))
        np.testing.assert_array_equal(now, then)
    saved = yaml.safe_load(path.read_text())["markers"][0]["T_world_marker"]["xyz_m"]
    np.testing.assert_allclose(saved, np.array([0, 1.47, 0.226]) + shift_m, atol=0.01 * MM)


@pytest.mark.parametrize("double", [False, True])
def test_what_a_map_counted_from_is_recorded_with_it(double):
    """A centre that lies between two round places is not rounded to the other one later."""
    T = np.array([[1.0, 0, 0, 0, 1e6 + 49.99, 0, 0], [1.0, 0, 0, 0, 1e6 + 50.0100001, 0.1, 0]])
    with jax.enable_x64(double):
        for origin_m in ((1e6, 0.0, 0.0), (1e6 + 100, 0.0, 0.0)):
            markers = marker_map(T, [0.1, 0.1], [0, 1], ["tag36h11"] * 2, origin_m)
            setup = dataclasses.replace(shifted_setup(FAR_M, double), markers=markers)
            header = json.loads(json.dumps(setup.header()))
            again = DriveSetup.from_header(header, Path("drive.mcap")).markers
            assert again.origin_m == origin_m
            now, then = (np.asarray(one.Ts_world_marker.wxyz_xyz) for one in (again, markers))
            np.testing.assert_array_equal(now, then)


def test_near_zero_a_header_is_what_it_was():
    assert "origin_m" not in shifted_setup(ZERO, True).header()
    # As older versions wrote it: in the coordinates of the file.
    header = shifted_setup(FAR_M, True).header()
    del header["origin_m"]
    assert DriveSetup.from_header(header, Path("a.mcap")).markers.origin_m == ZERO


class Driven:
    """A drive, and how far off what is acted upon was, in the world of the files."""

    def __init__(self, by_m, duration_s: float = 7.0):
        self.setup = shifted_setup(by_m, float64=False)
        origin_m, at = self.setup.markers.origin_m, np.array(self.setup.route.start_pose[:2])
        # The program that the commands below load too.
        self.steps = simulated(self.setup, duration_s, step_folder())
        self.healths = np.array([step.outcome.health for step in self.steps])
        poses = np.array([step.outcome.pose for step in self.steps])
        truth = np.array([planar_in_world(step.truth[:3], origin_m) for step in self.steps])
        decided = np.array([bool(step.outcome.output.decided) for step in self.steps])
        assert np.linalg.norm(truth[0, :2] - at) < 1 * MM
        self.errors_m = np.linalg.norm((poses - truth)[:, :2], axis=1)[decided]
        self.poses = poses


@pytest.fixture(scope="module")
def at_zero() -> Driven:
    with jax.enable_x64(False):
        return Driven(ZERO)


@pytest.fixture(
    scope="module", params=[pytest.param(far, marks=pytest.mark.long) for far in (EARTH_M, FAR_M)]
)
def away(request) -> Driven:
    with jax.enable_x64(False):
        return Driven(request.param)


def test_in_float32_a_drive_far_from_zero_is_as_good(at_zero, away):
    """The last bits of the coordinates differ, and errors with them: by less than a fifth."""
    for share in (0.5, 0.8, 0.95):
        here, there = (np.quantile(one.errors_m, share) for one in (at_zero, away))
        assert there < 1.2 * here
    assert len(away.errors_m) == pytest.approx(len(at_zero.errors_m), rel=0.05)
    shares = [np.mean(d.healths == Health.OK) for d in (at_zero, away)]
    assert shares[1] == pytest.approx(shares[0], abs=0.02)
    assert shares[0] > 0.9


def test_a_recording_holds_the_world_and_replays_to_the_bits(away, tmp_path):
    path = tmp_path / "drive.mcap"
    told = [(step.input, step.outcome) for step in away.steps[:120]]
    record(path, away.setup.header(), told)
    log = read_drive(path)
    np.testing.assert_array_equal(log.outcomes.pose, away.poses[:120])
    located = log.outcomes.located
    start_m = np.array(away.setup.route.start_pose[:2])
    assert np.linalg.norm(log.outcomes.pose[located, :2] - start_m, axis=1).max() < 3
    comparison = Comparison(log)
    with jax.enable_x64(False):
        setup = DriveSetup.from_header(log.header, path)
        for outcome in replay_drive(log.inputs, setup, step_folder()):
            comparison.look(outcome)
    assert comparison.first is None
    assert comparison.compared == 120
    # By another machine too, what is off is seen: by the map's numbers, not by 10 000 km.
    log.outcomes.pose[60, 0] += 0.2
    comparison = Comparison(dataclasses.replace(log, header=log.header | {"made_by": {}}))
    assert not comparison.bit_for_bit
    with jax.enable_x64(False):
        for outcome in replay_drive(log.inputs[:80], setup, step_folder()):
            comparison.look(outcome)
    assert comparison.first is not None
    assert comparison.first.what.startswith("pose")


def drawn_m(scenery: Scenery, outcomes: Outcomes, index: int) -> list[np.ndarray]:
    """What Rerun is told: where the vehicle, the hypotheses and the candidates are."""
    rerun = MagicMock()
    scene = RerunScene(rerun, MagicMock(), scenery.rig, scenery.markers, np.zeros((0, 2)))
    rerun.Arrows3D.reset_mock()
    scene.show(outcomes, index)
    arrows = [np.array(call.kwargs["origins"]) for call in rerun.Arrows3D.call_args_list]
    return [np.array(rerun.Transform3D.call_args.kwargs["translation"]), *arrows]


def test_what_is_drawn_of_a_recording_lies_among_its_markers(away, tmp_path):
    path = tmp_path / "drive.mcap"
    record(path, away.setup.header(), [(s.input, s.outcome) for s in away.steps[:90]])
    log = read_drive(path)
    scenery = Scenery.from_header(log.header)
    index = int(np.flatnonzero([len(Ts) for Ts in log.outcomes.Ts_vehicle_world])[-1])
    pose_m = log.outcomes.pose[index, :2]
    assert np.linalg.norm(scenery.markers_m[0, 0, :2] - pose_m) < 5
    assert np.linalg.norm(scenery.waypoints_m[0] - pose_m) < 5
    taken = int(log.outcomes.selected[index])
    T = poses.inverse(log.outcomes.Ts_vehicle_world[index][taken])
    assert np.linalg.norm(T[4:6] - pose_m) < 0.1
    # What Rerun is told, which has float32 alone, is near zero, and the same as while it drives.
    outcome = away.steps[index].outcome
    shown, live = (
        drawn_m(scenery, *row)
        for row in ((log.outcomes, index), (Outcomes.from_outcome(outcome), 0))
    )
    for places_m, live_m in zip(shown, live, strict=True):
        assert np.abs(places_m).max() < 60
        np.testing.assert_allclose(places_m, live_m, atol=0.01 * MM)
    np.testing.assert_allclose(shown[0][:2], outcome.output.pose[:2], atol=0.01 * MM)
    T_live = poses.inverse(
        outcome.output.candidates.T_vehicle_world.wxyz_xyz.astype(float)[
            int(outcome.output.selected)
        ]
    )
    np.testing.assert_allclose(shown[2][taken], T_live[4:], atol=0.1 * MM)
    assert np.abs(scenery.on_map_m(scenery.waypoints_m)).max() < 60


def test_the_status_line_tells_the_world_and_keeps_its_width(away):
    outcome = dataclasses.replace(away.steps[-1].outcome, health=Health.DEAD_RECKONING)
    line = status_line(outcome, 30.4, 4.2, True)
    assert len(line) <= WIDTH
    assert f"x{outcome.pose[0]:12.2f} y{outcome.pose[1]:12.2f}" in line


def test_a_trajectory_has_its_millimetres(tmp_path):
    T = np.array([[1.0, 0, 0, 0, 12_345_678.123456, -0.123456789, 999.123456]])
    write_tum(tmp_path / "a.tum", np.array([1.5]), T)
    read = np.loadtxt(tmp_path / "a.tum")
    assert abs(read[1] - T[0, 4]) < 1e-6
    assert read[2] == -0.123456789
    assert read[3] == 999.123456


@pytest.fixture(scope="module")
def command_process():
    """Commands choose a precision and a cache; what they change is put back."""
    before = jax.config.jax_enable_x64
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("JAX_COMPILATION_CACHE_DIR", "kept")
        yield
    configure_jax(float64=before)


def test_commands_tell_the_world(away, tmp_path, command_process, capsys):
    recording = tmp_path / "drive.mcap"
    record(recording, away.setup.header(), [(s.input, s.outcome) for s in away.steps[:100]])
    out = tmp_path / "out"
    assert main(["replay", str(recording), "--out", str(out), "--headless"]) == 0
    rows = np.loadtxt(out / "trajectory.tum")
    located = [bool(s.outcome.output.located) for s in away.steps[:100]]
    np.testing.assert_allclose(rows[:, 1:3], away.poses[:100][located][:, :2], atol=0.01 * MM)
    final = json.loads((out / "summary.json").read_text())["final_pose"]
    np.testing.assert_allclose(final[:2], away.poses[99, :2], atol=0.01 * MM)
    assert main(["plot", str(recording), "--out", str(out)]) == 0


def test_a_route_file_goes_with_its_map(tmp_path):
    data = yaml.safe_load((QCAR / "route.yaml").read_text())
    data["waypoints_m"] = (np.array(data["waypoints_m"]) + UTM_M[:2]).tolist()
    data["start"]["x_m"] += UTM_M[0]
    data["start"]["y_m"] += UTM_M[1]
    RouteFile.model_validate(data)
    (tmp_path / "route.yaml").write_text(yaml.safe_dump(data))
    route = load_route(tmp_path / "route.yaml")
    origin_m = MarkerFile.model_validate(shifted_map(UTM_M)).map().origin_m
    near = load_route(QCAR / "route.yaml")
    moved = route.relative_to(origin_m)
    rest_m = np.array(UTM_M[:2]) - origin_m[:2]
    np.testing.assert_allclose(moved.waypoints_m, near.waypoints_m + rest_m, atol=1e-6)
    np.testing.assert_allclose(moved.start_pose[:2], near.start_pose[:2] + rest_m, atol=1e-6)
    assert math.isclose(moved.start_pose[2], near.start_pose[2])
