"""Odometry whose stamps are off: how far is told by how the body turns."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from jaxnav.recordings.ros.odometry_track import GrowingTrack, OdometryTrack, odometry_delay

STAMPS_NS = np.arange(100) * 200_000_000  # 20 s of frames at 5 Hz
IDENTITY = np.array([1.0, 0, 0, 0, 0, 0, 0])


def poses(times_s: np.ndarray, swing_rad: float, noise_rad: float = 0.0) -> np.ndarray:
    """A hand that turns to and fro, (F, 7), as markers see it."""
    rng = np.random.default_rng(0)
    swings = [np.sin(rate * times_s + k) for k, rate in enumerate((2.1, 3.4, 1.3))]
    turns = swing_rad * np.stack(swings, axis=1) + noise_rad * rng.normal(size=(len(times_s), 3))
    wxyz = np.roll(Rotation.from_rotvec(turns).as_quat(), 1, axis=1)
    return np.concatenate([wxyz, np.zeros((len(times_s), 3))], axis=1)


def told(delay_s: float, swing_rad: float) -> OdometryTrack:
    """Odometry at 30 Hz, from 2 s before the frames to 2 s after, stamped `delay_s` too late."""
    times_s = np.arange(-2, 22, 1 / 30)
    stamps_ns = np.round((times_s + delay_s) * 1e9).astype(np.int64)
    return OdometryTrack(stamps_ns, poses(times_s, swing_rad), IDENTITY)


@pytest.mark.parametrize("delay_s", [-0.46, 0.3])
def test_stamps_that_are_off_are_told_to_a_frame(delay_s):
    seen = np.arange(100) % 7 > 0
    shown = poses(STAMPS_NS / 1e9, 0.1, np.deg2rad(0.5))
    track = told(delay_s, 0.1)
    found = odometry_delay(track, STAMPS_NS, shown, seen)
    assert found.delay_s == pytest.approx(delay_s, abs=0.03)
    assert found.misfit_rad[0] < 0.5 * found.misfit_rad[1]
    assert f"with a delay of {found.delay_s:.2f} s" in str(found)
    assert odometry_delay(track.earlier_by(found.delay_s), STAMPS_NS, shown, seen) is None


def test_nothing_is_told_where_stamps_fit_or_nothing_turns():
    shown = poses(STAMPS_NS / 1e9, 0.1, np.deg2rad(0.5))
    seen = np.ones(100, bool)
    assert odometry_delay(told(0.0, 0.1), STAMPS_NS, shown, seen) is None
    still = poses(STAMPS_NS / 1e9, 0.0, np.deg2rad(0.5))
    assert odometry_delay(told(0.4, 0.0), STAMPS_NS, still, seen) is None
    assert odometry_delay(told(0.4, 0.1), STAMPS_NS, shown, seen & False) is None
    assert odometry_delay(told(60.0, 0.1), STAMPS_NS, shown, seen) is None  # none of these times


def test_a_track_that_grows_takes_its_delay_away_as_a_whole_one_does():
    track = told(0.3, 0.1)
    growing = GrowingTrack(IDENTITY, delay_s=0.3)
    for stamp_ns, pose in zip(track.stamps_ns, track.T_odom_sensor, strict=True):
        growing.add(stamp_ns, pose)
    last_ns = track.stamps_ns[-1] - 300_000_000
    assert growing.reaches(last_ns)
    assert not growing.reaches(last_ns + 1)
    times_ns = np.array([3, 4]) * 200_000_000
    expected = track.earlier_by(0.3).twists(times_ns)[1]
    np.testing.assert_allclose(growing.twist(*times_ns), expected, atol=1e-12)
    assert np.linalg.norm(expected[3:]) > 0.01
