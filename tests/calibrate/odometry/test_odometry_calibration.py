"""Calibration of odometry from drives past a marker: against a simulated car's truth, and on drives
that cannot determine it."""

import dataclasses
import math

import numpy as np
import pytest
from scipy.optimize import approx_fprime

from jaxnav.calibrate.odometry import model as odometry_model
from jaxnav.calibrate.odometry import start as odometry_start
from jaxnav.calibrate.odometry.calibrate import calibrate_odometry
from jaxnav.calibrate.odometry.drive import Drive, lay_out, reading_sigma
from jaxnav.calibrate.odometry.fit import Prior, System
from jaxnav.calibrate.odometry.model import NAMES, Model
from jaxnav.errors import BadInput
from tests import worlds
from tests.helpers.odometry_drives import RECIPE, START, TRUTH, Leg, Sensors, sensed, true_track

BEFORE = dict(zip(NAMES, (1.0, 1.0, 0.0, 0.256, 0.0), strict=True))
STRAIGHT = -TRUTH[2] / TRUTH[1] / 0.5  # of the servo's limit, where the car drives straight
LINE = (0.3, -2.2, math.pi / 2)


def calibrate(*drives: Drive, before=BEFORE, **how):
    return calibrate_odometry(drives, worlds.qcar_rig(), worlds.paper_markers(), before, **how)


def driven(legs, duration_s, seed=0, pose=START, sensors=None, begin_s=0.0) -> Drive:
    track = true_track(legs, duration_s, start=pose)
    track = track[track[:, 0] >= begin_s] - np.array([begin_s, 0, 0, 0, 0, 0])
    return sensed(track, worlds.qcar_rig(), worlds.paper_markers(), seed, sensors=sensors)


def errors(found) -> np.ndarray:
    return np.array([found.value[name] for name in NAMES]) - TRUTH


def allowed() -> np.ndarray:
    """1 % of a figure; of the steering's limit for its offset, 1 ms for the delay."""
    scale, gain, _, wheelbase_m, _ = TRUTH
    return np.array([0.01 * scale, 0.01 * gain, 0.005, 0.01 * wheelbase_m, 0.001])


@pytest.fixture(scope="module")
def minute():
    return driven(RECIPE, 60.0)


@pytest.fixture(scope="module")
def recipe(minute):
    return calibrate(minute)


def test_a_minute_of_eights_gives_every_figure(recipe):
    assert recipe.fixed == {}
    assert np.all(np.abs(errors(recipe)) < allowed())
    sigma = np.array([recipe.sigma[name] for name in NAMES])
    assert np.all(np.abs(errors(recipe)) < 4 * sigma)
    assert np.all(sigma < allowed() / 2)
    assert recipe.chi2_per_dof == pytest.approx(1.0, abs=0.05)
    assert recipe.inflation == 1
    assert recipe.rms_px == pytest.approx(0.3, rel=0.1)
    assert recipe.reading_sigma.speed_mps == pytest.approx(0.01, rel=0.1)
    assert recipe.reading_sigma.steering_rad == pytest.approx(0.005, rel=0.1)
    assert not recipe.outliers.sum() > 5

    track = true_track(RECIPE, 60.0, start=START)
    true = np.column_stack(
        [np.interp(recipe.node_times_s, track[:, 0], column) for column in track[:, 1:4].T]
    )
    assert np.abs(recipe.poses[:, :2] - true[:, :2]).max() < 0.05
    assert np.sqrt(np.mean((recipe.poses[:, :2] - true[:, :2]) ** 2)) < 0.01


def test_wrong_detections_count_little():
    found = calibrate(driven(RECIPE, 60.0, seed=1, sensors=Sensors(wrong_share=0.02)))
    assert np.all(np.abs(errors(found)) < allowed())
    assert 10 < found.outliers.sum() < 60


def test_parts_that_disagree_make_the_sigmas_larger(minute, recipe):
    """Wheels that spin by 3 % for 2 s of 6: residuals hardly grow, the scale's error about its mean
    three times. The mean itself is found."""
    spins = (minute.reading_stamps_ns - minute.reading_stamps_ns[0]) % 6_000_000_000 < 2_000_000_000
    speed_mps = minute.speed_mps * np.where(spins, 1.03, 1.0)
    found = calibrate(dataclasses.replace(minute, speed_mps=speed_mps))
    assert found.inflation > 5 * found.chi2_per_dof > 5
    assert found.sigma["speed_scale"] > 2 * recipe.sigma["speed_scale"]
    mean = recipe.value["speed_scale"] / 1.01
    assert abs(found.value["speed_scale"] - mean) < 3 * found.sigma["speed_scale"]
    assert any(sentence.startswith("parts of the drives disagree") for sentence in found.advice)


def test_recordings_add_up(recipe):
    halves = [driven(RECIPE, 30.0, seed=2), driven(RECIPE[3:], 30.0, seed=3)]
    found = calibrate(*halves)
    assert np.all(np.abs(errors(found)) < allowed())
    assert found.duration_s == pytest.approx(60.0, abs=1.0)
    for name in NAMES:
        assert found.sigma[name] == pytest.approx(recipe.sigma[name], rel=1.0)


def test_a_straight_line_gives_scale_and_offset_alone():
    legs = [Leg(STRAIGHT, 0.5, time_s=1.5), Leg(STRAIGHT, 0.0, time_s=1.0)]
    found = calibrate(driven(legs, 16.0, pose=LINE))
    assert set(found.fixed) == {"steering_gain", "wheelbase_m"}
    assert "full lock" in found.fixed["steering_gain"]
    assert found.value["steering_gain"] == BEFORE["steering_gain"]
    assert set(found.sigma) == {"speed_scale", "steering_offset_rad", "camera_delay_s"}
    for name, sigma in found.sigma.items():
        assert abs(found.value[name] - TRUTH[NAMES.index(name)]) < 4 * sigma
    assert any("steering_gain" in sentence for sentence in found.advice)


def test_the_delay_does_not_show_at_constant_speed():
    found = calibrate(driven([Leg(STRAIGHT, 0.25)], 16.0, pose=LINE, begin_s=2.0))
    assert "camera_delay_s" in found.fixed
    assert found.value["camera_delay_s"] == 0.0
    assert "stop and start" in found.fixed["camera_delay_s"]


def test_one_circle_is_refused_unless_the_offset_is_given():
    drive = driven([Leg(0.8, 0.5), Leg(0.8, 0.0, time_s=0.7)], 25.0)
    with pytest.raises(BadInput, match="gain and its offset are one: drive eights"):
        calibrate(drive)


def test_a_wheelbase_measured_by_tape_is_kept(minute):
    measured = BEFORE | {"wheelbase_m": float(TRUTH[3])}
    found = calibrate(minute, before=measured, wheelbase_sigma_m=1e-5)
    assert found.value["wheelbase_m"] == pytest.approx(TRUTH[3], abs=4e-5)
    assert found.sigma["wheelbase_m"] < 1.1e-5
    fixed = calibrate(minute, before=measured, fixed=("wheelbase_m",))
    assert fixed.fixed == {"wheelbase_m": "as given by --fix"}
    assert "wheelbase_m" not in fixed.sigma
    assert fixed.sigma["steering_gain"] == pytest.approx(found.sigma["steering_gain"], rel=0.05)


def test_too_little_is_refused_with_what_to_do():
    drive = driven(RECIPE, 20.0)
    blind = {"view_stamps_ns": drive.view_stamps_ns[:0], "camera": drive.camera[:0]}
    blind |= {"marker": drive.marker[:0], "corners_px": drive.corners_px[:0]}
    with pytest.raises(BadInput, match=r"seen 0 times.*at least 30 views"):
        calibrate(dataclasses.replace(drive, sigma_px=drive.sigma_px[:0], **blind))
    with pytest.raises(BadInput, match="0 readings of the odometer"):
        calibrate(dataclasses.replace(drive, speed_mps=np.full_like(drive.speed_mps, np.nan)))
    with pytest.raises(BadInput, match=r"drove 0\.0. m in view of markers, at least 1 m"):
        calibrate(driven([Leg(0.0, 0.0)], 10.0, pose=LINE))


def test_a_car_that_is_carried_contradicts_its_odometer():
    drive = driven(RECIPE, 10.0)
    slow = 0.3 + 0.2 * np.sin(np.arange(len(drive.speed_mps)) / 100)
    backwards = dataclasses.replace(drive, speed_mps=slow)
    with pytest.raises(BadInput, match=r"contradict each other|not where the map says"):
        calibrate(backwards)


def test_single_spikes_are_not_believed(minute, recipe):
    speed = minute.speed_mps.copy()
    speed[500:2500:400] = 40.0
    found = calibrate(dataclasses.replace(minute, speed_mps=speed))
    for name in NAMES:
        assert found.value[name] == pytest.approx(recipe.value[name], abs=recipe.sigma[name])


@pytest.fixture(scope="module")
def short():
    """A course of some seconds with its model, away from the minimum."""
    drive = driven(RECIPE, 5.0)
    rig, markers = worlds.qcar_rig(), worlds.paper_markers()
    course = lay_out([drive])
    theta = np.array([1.02, 0.98, 0.01, 0.258, 0.013])
    nodes = odometry_start.start(course, rig, markers, theta)
    nodes[:-1, 3:] = 0.1 * np.random.default_rng(0).standard_normal((len(nodes) - 1, 2))
    return Model(course, rig, markers, reading_sigma(course.intervals)), nodes, theta


def test_the_gradient_is_the_costs(short):
    """Half of the cost's, by differences, in every parameter and in some nodes."""
    model, nodes, theta = short
    free, prior = np.ones(5, bool), Prior(theta, np.zeros(5))
    system = System.from_blocks(model.blocks(nodes, theta), theta, free, prior)
    rows = [(3, 0), (50, 1), (100, 2), (100, 3), (150, 4)]

    def cost(moved: np.ndarray) -> float:
        shifted = nodes.copy()
        for (node, column), value in zip(rows, moved[5:], strict=True):
            shifted[node, column] = value
        return model.blocks(shifted, moved[:5]).cost

    at = np.concatenate([theta, [nodes[row] for row in rows]])
    numeric = approx_fprime(at, cost, 1e-7)
    mine = np.concatenate(
        [system.gradient_theta, [system.gradient_nodes.reshape(-1, 5)[row] for row in rows]]
    )
    np.testing.assert_allclose(2 * mine, numeric, rtol=2e-3, atol=2e-3 * np.abs(numeric).max())


def test_the_band_solves_what_a_dense_matrix_does(short):
    model, nodes, theta = short
    free = np.array([True, True, False, True, True])
    prior = Prior(theta, np.array([0, 0, 0, 1e4, 0.0]))
    blocks = model.blocks(nodes, theta)
    system = System.from_blocks(blocks, theta, free, prior)
    count = len(blocks.information)
    dense = np.zeros((5 * (count + 1) + 5,) * 2)
    gradient = np.zeros(len(dense))
    for k in range(count):
        rows = [*range(5 * k, 5 * k + 8), *range(5 * (count + 1), 5 * (count + 1) + 5)]
        dense[np.ix_(rows, rows)] += blocks.information[k]
        gradient[rows] += blocks.gradient[k]
    dense[range(5 * (count + 1)), range(5 * (count + 1))] += 1e-9
    dense[range(5 * count + 3, 5 * count + 5), range(5 * count + 3, 5 * count + 5)] += 1.0
    dense[-2, -2] += 1e4
    kept = np.r_[0 : 5 * (count + 1), 5 * (count + 1) + np.flatnonzero(free)]
    dense, gradient = dense[np.ix_(kept, kept)], gradient[kept]
    damped = dense + 0.01 * np.diag(np.diag(dense))
    expected = -np.linalg.solve(damped, gradient)
    step_nodes, step_theta, _ = system.solved(0.01)
    np.testing.assert_allclose(step_theta, expected[-4:], rtol=1e-6)
    np.testing.assert_allclose(step_nodes.ravel(), expected[:-4], rtol=1e-5, atol=1e-9)
    information, inner = system.eliminated(0.0)
    scores, border = system.scores(blocks, free, inner), dense[:-4, -4:]
    reduced = gradient[-4:] - border.T @ np.linalg.solve(dense[:-4, :-4], gradient[:-4])
    assert scores.shape == (20, 4)
    np.testing.assert_allclose(scores.sum(axis=0), reduced, rtol=1e-5)
    covariance = np.linalg.inv(dense)[-4:, -4:]
    np.testing.assert_allclose(np.linalg.inv(information), covariance, rtol=1e-4)


def test_a_course_is_cut_where_readings_are_missing():
    drive = driven(RECIPE, 20.0)
    stamps = drive.reading_stamps_ns
    kept = (stamps < stamps[0] + 8e9) | (stamps > stamps[0] + 9e9)
    columns = {
        name: getattr(drive, name)[kept]
        for name in ("reading_stamps_ns", "speed_mps", "steering_rad")
    }
    course = lay_out([dataclasses.replace(drive, **columns)])
    assert course.stretches == 2
    assert course.duration_s == pytest.approx(19.0, abs=0.2)
    assert np.all(np.diff(course.node_times_s) > 0)
    inside = (course.views.time_s >= course.intervals.begin_s[course.views.first]) & (
        course.views.time_s <= course.node_times_s[course.views.last + 1]
    )
    assert inside.all()


def test_nothing_is_compiled_anew_for_another_drive_of_this_length(minute, recipe):
    columns = ("reading_stamps_ns", "speed_mps", "steering_rad")
    shorter = {name: getattr(minute, name)[100:] for name in columns}
    course = lay_out([dataclasses.replace(minute, **shorter)])
    rig, markers = worlds.qcar_rig(), worlds.paper_markers()
    before = [of._cache_size() for of in (odometry_model._blocks, odometry_start._poses_of_views)]
    nodes = odometry_start.start(course, rig, markers, TRUTH)
    Model(course, rig, markers, reading_sigma(course.intervals)).blocks(nodes, TRUTH)
    assert before == [
        of._cache_size() for of in (odometry_model._blocks, odometry_start._poses_of_views)
    ]
