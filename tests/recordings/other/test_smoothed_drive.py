"""Smoothed drives: nearer to the truth than the filter, by as much as they say, from the start."""

import numpy as np
import pytest

from jaxnav.cli import main
from jaxnav.recordings.drive_events import DriveEvents
from jaxnav.recordings.other.localise import DriveTrack, smooth_drive
from jaxnav.vehicles.conformance.lockstep import Rates, Step
from tests.helpers.simulated import make_setup, simulated
from tests.recordings.test_regression import FOLDER

pytestmark = pytest.mark.long
# Cameras see nothing in between.
HIDDEN_S = (1.5, 2.5)


@pytest.fixture(scope="module")
def tracks() -> tuple[DriveTrack, DriveTrack, np.ndarray]:
    """A drive with a tunnel, filtered and smoothed, and the true poses (N, 3)."""
    setup = make_setup()
    begin_ns = 0

    def change(given):
        nonlocal begin_ns
        begin_ns = begin_ns or given.now_ns
        hidden = HIDDEN_S[0] < (given.now_ns - begin_ns) / 1e9 < HIDDEN_S[1]
        return [] if hidden and given.frames else [given]

    steps = simulated(setup, 4.0, rates=Rates(0.04, 1 / 15), change=change)
    events = DriveEvents.from_inputs([step.input for step in steps], setup, FOLDER)
    done: list[int] = []
    filtered, smoothed = smooth_drive(events, setup, done.append)
    assert sum(done) == 2 * len(events)
    return filtered, smoothed, true_poses(steps, events)


def true_poses(steps: list[Step], events: DriveEvents) -> np.ndarray:
    now_ns = [step.input.now_ns for step in steps]
    truth = np.array([step.truth[:3] for step in steps])
    truth[:, 2] = np.unwrap(truth[:, 2])
    return np.stack([np.interp(events.stamps_ns, now_ns, column) for column in truth.T], axis=1)


def off_m(track: DriveTrack, truth: np.ndarray) -> np.ndarray:
    return np.hypot(*(track.poses - truth)[:, :2].T)


def rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(values**2)))


def test_it_is_nearer_to_the_truth(tracks):
    filtered, smoothed, truth = tracks
    before, after = off_m(filtered, truth), off_m(smoothed, truth)
    first_s = filtered.stamps_ns < filtered.stamps_ns[0] + 1_000_000_000
    assert rms(after[first_s]) < 0.3 * rms(before[first_s])
    assert rms(after[~first_s]) < 0.9 * rms(before[~first_s])
    turn = np.angle(np.exp(1j * (smoothed.poses - truth)[:, 2]))
    assert rms(np.rad2deg(turn)) < 0.5
    np.testing.assert_array_equal(smoothed.Ts_world_vehicle[:, 4:6], smoothed.poses[:, :2])


def test_both_branches_are_weighed_over_all_of_it(tracks):
    """The filter has to wait for the motion that tells them apart."""
    filtered, smoothed, _ = tracks
    assert np.argmax(filtered.decided) > 3
    assert np.all(smoothed.decided)
    assert np.all(smoothed.located)


def test_it_is_known_as_well_as_it_says(tracks):
    filtered, smoothed, truth = tracks
    assert np.all(smoothed.sigma_m <= 1.001 * filtered.sigma_m)
    assert np.all(smoothed.sigma_rad <= 1.001 * filtered.sigma_rad)
    # Its own last event is all that the filter knows.
    assert smoothed.sigma_m[-1] == pytest.approx(filtered.sigma_m[-1], rel=1e-6)
    assert np.all(off_m(smoothed, truth) < 3 * smoothed.sigma_m)
    turn = np.angle(np.exp(1j * (smoothed.poses - truth)[:, 2]))
    assert np.all(np.abs(turn) < 3 * smoothed.sigma_rad)


def test_a_recorded_drive_is_smoothed_from_the_command_line(tmp_path, capsys):
    """Also where somebody carries the car off: two tracks, and none between them."""
    arguments = ["replay", FOLDER / "kidnapped.mcap", "--smooth", "--out", tmp_path, "--headless"]
    main([str(argument) for argument in arguments])
    text = capsys.readouterr().out
    assert "smoothed 99%; sigma" in text
    assert "the filter was off the smoothed track by" in text
    assert (tmp_path / "smoothed.png").stat().st_size > 10_000
    positions_m = np.loadtxt(tmp_path / "smoothed.tum")[:, 1:4]
    gaps_m = np.linalg.norm(np.diff(positions_m, axis=0), axis=1)
    assert np.sum(gaps_m > 0.3) == 1
