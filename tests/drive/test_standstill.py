"""Standstill of a camera, an odometer or the car while others move, on a road past a marker."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from jaxnav.drive.chassis import Motion, car_motion
from jaxnav.drive.standstill import Standstill, Way, between

MS = 1_000_000
BEGIN_NS = 10**12
SIGMA_PX = 0.3
WHEELBASE_M = 0.256
PX_PER_M = 100.0  # a focal length of 300 px, 3 m away
QUAD_PX = np.array([[[400.0, 200.0], [420.0, 200.0], [420.0, 220.0], [400.0, 220.0]]])
VISIBLE = np.ones(1, bool)


def due(motion):
    """Sideways, as far as the vehicle goes ahead."""
    return QUAD_PX[None], QUAD_PX[None] - PX_PER_M * np.array([motion[0], motion[1]])


def ahead(motion):
    """Of a marker so far ahead that nothing is to be seen of the motion."""
    return QUAD_PX[None], QUAD_PX[None] * (1 + 1e-4 * motion[0])


class Drive:
    """Odometry each 20 ms, a frame each 40 ms."""

    def __init__(self, seed=0):
        self.standstill = Standstill(Way(), 0.3)
        self.now_ns = BEGIN_NS
        self.x_m = 0.0  # of what the camera shows
        self.rng = np.random.default_rng(seed)

    def go(
        self, duration_s, told_mps=0.0, true_mps=0.0, throttle=0.0, noise_px=0.0, of=due, **silent
    ):
        """Whether frames were frozen, and whether corners contradicted the odometer, in turn."""
        frozen, contradicted = [], []
        for count in range(round(duration_s / 0.02)):
            self.now_ns += 20 * MS
            self.x_m += 0.02 * true_mps
            if "odometry" not in silent:
                contradicted.append(self.standstill.add_reading(self.now_ns, self.now_ns, told_mps))
                if not contradicted[-1] and "refused" not in silent:
                    ahead = Motion(told_mps, 0.0, 0.0)
                    self.standstill.add_believed(self.now_ns, self.now_ns, told_mps, ahead)
            if count % 2 == 0 and "frames" not in silent:
                noise = noise_px * self.rng.standard_normal(QUAD_PX.shape)
                corners_px = of((self.x_m, 0.0, 0.0))[1][0] + noise
                frozen.append(
                    self.standstill.is_frozen(
                        0, self.now_ns, self.now_ns, corners_px, VISIBLE, SIGMA_PX, of
                    )
                )
            self.standstill.add_command((10.0 * throttle,), self.now_ns)
        return frozen, contradicted


def test_a_camera_that_stays_while_the_odometer_goes_is_frozen_until_it_moves():
    drive = Drive()
    assert not any(drive.go(1.0, 0.4, 0.4, noise_px=SIGMA_PX)[0])
    frozen, _ = drive.go(1.0, told_mps=0.4, noise_px=0.01)
    assert frozen == sorted(frozen)
    assert 0.1 / 0.4 <= 0.04 * frozen.index(True) <= 0.1 / 0.4 + 4 * 0.04
    assert all(drive.go(8.0, noise_px=0.01)[0])  # also when it stands: nothing has shown it alive
    drive.x_m += 0.4
    assert not any(drive.go(1.0, 0.4, 0.4)[0])


def test_what_stays_where_nothing_is_due_is_not_frozen():
    assert not any(Drive().go(30.0, noise_px=0.01)[0])  # the vehicle stands
    assert not any(Drive().go(30.0, told_mps=0.008, noise_px=0.01)[0])  # the odometer's error
    assert not any(Drive().go(4.0, told_mps=0.4, noise_px=0.01, of=ahead)[0])


@given(st.floats(0.03, 1.0), st.floats(0.7, 1.4), st.integers(0, 2**31), st.booleans())
def test_a_camera_that_sees_is_not_frozen(speed_mps, scale, seed, stops):
    """Wheels that slip, corners with noise, and starts and stops."""
    drive = Drive(seed)
    for _ in range(3):
        assert not any(drive.go(0.6, scale * speed_mps, speed_mps, noise_px=SIGMA_PX)[0])
        assert not (stops and any(drive.go(0.4, noise_px=SIGMA_PX)[0]))


def test_corners_that_move_while_the_odometer_stands_contradict_it():
    drive = Drive()
    assert not any(drive.go(1.0, 0.4, 0.4)[1])
    _, contradicted = drive.go(1.0, told_mps=0.0, true_mps=0.4, noise_px=SIGMA_PX)
    assert 0.3 < 0.02 * contradicted.index(True) < 0.6
    assert all(contradicted[contradicted.index(True) :])
    assert not any(drive.go(1.0, 0.4, 0.4)[1])  # it goes again


def test_a_push_a_late_frame_and_noise_do_not():
    drive = Drive()
    drive.go(1.0, 0.4, 0.4)
    assert not any(drive.go(0.1, told_mps=0.0, true_mps=0.4)[1])  # frames 100 ms late
    assert not any(drive.go(20.0, noise_px=SIGMA_PX)[1])
    drive.x_m += 0.3  # somebody moves it, or the marker
    assert not any(drive.go(2.0, noise_px=SIGMA_PX)[1])


@pytest.mark.parametrize("silent", [{"frames": None}, {}, {"odometry": None}, {"refused": None}])
def test_where_nothing_moves_the_throttle_pulls_for_a_second(silent):
    """Held fast, or frozen all of it: without a camera that sees, or an odometer that tells."""
    drive = Drive()
    drive.go(3.0)
    drive.go(0.96, throttle=0.05, noise_px=0.01, **silent)
    assert not drive.standstill.nothing_moves
    drive.go(0.2, throttle=0.05, noise_px=0.01, **silent)
    assert drive.standstill.nothing_moves
    drive.go(5.0, noise_px=SIGMA_PX)
    assert drive.standstill.nothing_moves  # it is not tried again
    if "frames" in silent:
        drive.go(0.2, told_mps=0.1)
    else:
        drive.go(0.2, true_mps=0.4)
    assert not drive.standstill.nothing_moves


def test_who_moves_or_does_not_pull_or_is_not_told_is_not_held():
    drive = Drive()
    drive.go(5.0, 0.3, 0.3, throttle=0.03, frames=None)
    drive.go(5.0, 0.0, 0.3, throttle=0.03, refused=None)  # corners alone
    drive.go(5.0, throttle=0.0)
    drive.go(5.0, throttle=0.05, frames=None, odometry=None)
    for _ in range(5):
        drive.go(0.9, throttle=0.3, noise_px=0.01)  # slow to start
        drive.go(0.1, told_mps=0.1, throttle=0.3)
    assert not drive.standstill.nothing_moves


@pytest.mark.parametrize(
    ("throttle", "earliest_s", "latest_s"), [(0.0, 0.9, 1.3), (0.03, 0.5, 0.8)]
)
def test_corners_contradict_sooner_where_the_throttle_pulls(throttle, earliest_s, latest_s):
    """Corners go at 6 px/s, a move of 1.8 px each 0.32 s: two moves are enough, else three."""
    drive = Drive()
    drive.go(0.2)
    _, contradicted = drive.go(2.0, true_mps=0.06, throttle=throttle)
    assert earliest_s < 0.02 * np.argmax(contradicted) < latest_s


numbers = st.floats(allow_nan=False, allow_infinity=False)


@given(
    st.lists(
        st.tuples(
            numbers | st.floats(-2, 2),
            st.integers(-(10**9), 10**9),
            st.lists(numbers | st.floats(0, 800), min_size=8, max_size=8),
            numbers.filter(lambda x: x > 0),
            st.floats(-0.3, 0.3),
        ),
        max_size=40,
    )
)
def test_whatever_is_told_nothing_raises(events):
    drive = Drive()
    for speed_mps, off_ns, corners_px, sigma_px, throttle in events:
        drive.now_ns += 10 * MS
        drive.standstill.add_reading(drive.now_ns + off_ns, drive.now_ns, speed_mps)
        if abs(speed_mps) < 10:
            motion = car_motion(speed_mps, 0.1, WHEELBASE_M)
            drive.standstill.add_believed(drive.now_ns + off_ns, drive.now_ns, speed_mps, motion)
        quad_px = np.array(corners_px).reshape(1, 4, 2)
        told = drive.now_ns + off_ns, drive.now_ns, quad_px, VISIBLE, sigma_px, due
        assert drive.standstill.is_frozen(0, *told) in (False, True)
        drive.standstill.add_command((10.0 * throttle,), drive.now_ns)


def test_nobody_knows_the_way_before_its_time_after_it_or_across_a_pause():
    way = Way()
    for step in range(100):
        way.go(step * 20 * MS, car_motion(0.5, 0.0, WHEELBASE_M))
    assert way.at(1980 * MS - 1600 * MS) is None
    assert way.at(1980 * MS + 150 * MS) is None
    assert between(way.at(1900 * MS), way.at(2030 * MS))[0] == pytest.approx(0.065)
    number = way.number
    way.go(2300 * MS, car_motion(0.5, 0.0, WHEELBASE_M))
    assert way.number == number + 1
    assert way.at(2200 * MS) is None
    way.go(2290 * MS, car_motion(5.0, 0.0, WHEELBASE_M))  # late
    assert way.at(2290 * MS) is None
