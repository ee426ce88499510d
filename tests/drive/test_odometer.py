"""Odometry is believed if the vehicle can move so; stuck and impossible readings are not."""

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from jaxnav.drive.flags import Fault
from jaxnav.drive.odometer import Odometer

MAX_MPS, PER_THROTTLE, LAG_S = 3.0, 10.0, 0.3
PERIOD_NS = 20_000_000
BEGIN_NS = 10**12


class Drive:
    """Readings every 20 ms."""

    def __init__(self):
        self.odometer = Odometer(MAX_MPS, LAG_S)
        self.count = 0

    def tell(self, speed_mps, believed=None, seeing=False, throttle=0.0, steering_rad=None):
        """Whether a reading is believed; its steering is never the same."""
        self.count += 1
        stamp_ns = BEGIN_NS + self.count * PERIOD_NS
        values = speed_mps, 1e-6 * self.count if steering_rad is None else steering_rad
        wanted_mps = throttle * PER_THROTTLE
        return self.odometer.judge(speed_mps, values, stamp_ns, believed, seeing, wanted_mps)

    def accelerate(self, throttle: float, count: int) -> tuple[float, list[bool]]:
        """As the car does: a lag of first order."""
        speed, taken = 0.0, []
        for _ in range(count):
            speed += (throttle * PER_THROTTLE - speed) * (1 - math.exp(-0.02 / LAG_S))
            taken.append(self.tell(speed, throttle=throttle)[0])
        return speed, taken


@pytest.mark.parametrize("throttle", [0.3, 0.05, -0.2])
def test_what_the_throttle_can_do_is_believed(throttle):
    drive = Drive()
    speed, taken = drive.accelerate(throttle, 100)
    assert all(taken)
    assert drive.odometer.last_mps == speed
    for _ in range(60):  # and it brakes
        speed *= math.exp(-0.02 / LAG_S)
        assert drive.tell(speed)[0]


@pytest.mark.parametrize("change", [lambda v: 10 * v, lambda v: -v, lambda v: v - 2**32 / 300])
def test_what_no_vehicle_can_do_is_refused_and_the_next_is_believed(change):
    drive = Drive()
    speed, _ = drive.accelerate(0.1, 60)
    for _ in range(3):
        assert drive.tell(change(speed), throttle=0.1) == (False, Fault(0))
        assert drive.tell(speed, throttle=0.1)[0]


def test_the_same_numbers_again_and_again_are_a_stuck_sensor():
    drive = Drive()
    drive.accelerate(0.1, 60)
    told = [drive.tell(1.0, throttle=0.1, steering_rad=0.1) for _ in range(40)]
    assert [taken for taken, _ in told] == [True] * 25 + [False] * 15
    assert {fault for _, fault in told[25:]} == {Fault.ODOMETRY_STUCK}
    assert drive.tell(1.0, throttle=0.1, steering_rad=0.11)[0]


def test_a_speed_that_the_motor_was_told_to_change_and_that_stays_is_stuck():
    """Also where the steering is never the same, since it is what was commanded."""
    steady, changing = Drive(), Drive()
    for drive in (steady, changing):
        drive.accelerate(0.04, 100)
        assert all(drive.tell(0.4, throttle=0.04)[0] for _ in range(100))  # a rough encoder
    assert all(steady.tell(0.4, throttle=0.04) == (True, Fault(0)) for _ in range(50))
    told = [changing.tell(0.4, throttle=0.02) for _ in range(50)]
    assert told[-1] == (False, Fault.ODOMETRY_STUCK)
    assert 0 < [taken for taken, _ in told].index(False) < 25
    assert changing.tell(0.39, throttle=0.02) == (True, Fault(0))


def test_a_sensor_that_stands_while_corners_move_is_stuck():
    odometer = Odometer(MAX_MPS, LAG_S)
    told = [
        odometer.judge(0.0, (0.0, 0.0), BEGIN_NS + n, None, True, 0.0, n == 1) for n in (0, 1, 2)
    ]
    assert told == [(True, Fault(0)), (False, Fault.ODOMETRY_STUCK), (True, Fault(0))]


def test_a_vehicle_that_stands_is_not_stuck():
    drive = Drive()
    assert all(drive.tell(0.0, steering_rad=0.0) == (True, Fault(0)) for _ in range(100))


def test_who_insists_is_believed_only_where_no_camera_knows_better():
    blind, seeing = Drive(), Drive()
    taken = [blind.tell(2.0, believed=(0.5, 0.01))[0] for _ in range(20)]
    assert taken == [False] * 10 + [True] * 10
    assert Drive().tell(1.0, believed=(0.5, 0.5))[0]  # an uncertain estimate refuses less
    assert not any(seeing.tell(2.0, (0.5, 0.01), seeing=True)[0] for _ in range(100))
    assert not any(Drive().tell(1.6 * MAX_MPS, believed=(0.5, 0.01))[0] for _ in range(100))


def test_a_sensor_that_was_wrong_must_go_the_way_that_cameras_see():
    """A reading that fits once in a while is not yet a sensor to be believed."""
    drive, believed = Drive(), (1.0, 0.02)
    for _ in range(20):
        drive.tell(-1.0, believed, seeing=True, throttle=0.1)
    assert not drive.tell(1.0, believed, seeing=True, throttle=0.1)[0]
    taken = [drive.tell(1.0, believed, seeing=True, throttle=0.1)[0] for _ in range(80)]
    assert taken.index(True) > 25
    assert all(taken[taken.index(True) :])


finite = st.floats(allow_nan=False, allow_infinity=False)


@given(
    st.lists(
        st.tuples(
            finite | st.floats(-4, 4),
            finite | st.floats(-0.5, 0.5),
            st.integers(-(2**62), 2**62) | st.integers(-(10**8), 10**8),
            st.none() | st.tuples(st.floats() | st.floats(-4, 4), st.floats()),
            st.booleans(),
            st.floats(-0.3, 0.3),
        ),
        max_size=60,
    )
)
def test_whatever_is_told_no_impossible_speed_is_believed(readings):
    odometer = Odometer(MAX_MPS, LAG_S)
    for speed_mps, steering_rad, off_ns, believed, seeing, throttle in readings:
        stamp_ns = BEGIN_NS + off_ns
        told = stamp_ns, believed, seeing, throttle * PER_THROTTLE
        taken, fault = odometer.judge(speed_mps, (speed_mps, steering_rad), *told)
        assert fault in (Fault(0), Fault.ODOMETRY_STUCK)
        if taken:
            assert abs(speed_mps) <= 1.5 * MAX_MPS + 0.05
            assert odometer.last_mps == speed_mps
