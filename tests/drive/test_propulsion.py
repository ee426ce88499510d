"""Evidence about the odometer from the throttle."""

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from jaxnav.drive.propulsion import DOUBT_M, Propulsion

PER_THROTTLE, LAG_S, GAP_S = 10.0, 0.3, 0.02


class Car:
    """A lag of first order, whose odometer can lie."""

    def __init__(self, gain: float = 1.0, lag_s: float = LAG_S):
        self.propulsion = Propulsion(LAG_S)
        self.gain, self.lag_s, self.speed_mps = gain, lag_s, 0.0

    def drive(self, throttle, seconds, lie=lambda v: v, seeing=False, disputed=False) -> bool:
        for _ in range(round(seconds / GAP_S)):
            target = self.gain * throttle * PER_THROTTLE
            self.speed_mps += (target - self.speed_mps) * (1 - math.exp(-GAP_S / self.lag_s))
            wanted_mps = throttle * PER_THROTTLE
            self.propulsion.add_reading(lie(self.speed_mps), wanted_mps, GAP_S, seeing, disputed)
        return self.propulsion.doubtful


commands = st.lists(st.tuples(st.floats(-0.3, 0.3), st.floats(0.02, 1.0)), max_size=20)


@given(commands, st.floats(0.6, 1.7), st.floats(0.6, 1.7))
def test_a_car_as_its_file_says_within_a_factor_is_believed(commands, gain, slower):
    car = Car(gain, slower * LAG_S)
    assert not any(car.drive(throttle, seconds) for throttle, seconds in commands)


def test_brakes_may_act_at_once():
    car = Car()
    car.drive(0.04, 2.0)
    assert not car.drive(0.0, 3.0, lie=lambda v: 0.0)


@pytest.mark.parametrize("by", [0.0, 0.3, 3.0, -1.0])
def test_what_the_throttle_contradicts_is_doubted_until_corners_confirm(by):
    car = Car()
    assert not car.drive(0.04, 2.0)
    assert car.drive(0.04, 0.6, lie=lambda v: by * v)
    off_m = car.propulsion.off_m
    assert off_m > DOUBT_M
    assert car.drive(0.04, 2.0)  # it does not tell by itself whether it was right
    assert car.propulsion.off_m == pytest.approx(off_m, abs=0.02)
    car.propulsion.confirm()
    assert not car.drive(0.04, 2.0)


def test_how_far_off_it_may_be_is_the_way_between_the_two():
    car = Car()
    car.drive(0.04, 2.0)
    car.drive(0.04, 2.0, lie=lambda v: 0.0)
    assert car.propulsion.off_m == pytest.approx(0.8, rel=0.05)


def test_a_throttle_that_moves_nothing_while_corners_agree_says_nothing():
    """A recorded drive, a car that is pushed."""
    car = Car()
    car.drive(0.0, 1.0, lie=lambda v: 0.5, seeing=True)
    car.propulsion.confirm()
    assert not car.drive(0.0, 3.0, lie=lambda v: 0.5)
    car.drive(0.04, 2.0, seeing=True)
    car.propulsion.confirm()
    assert car.drive(0.04, 1.0, lie=lambda v: 0.0)


def test_an_odometer_that_the_corners_dispute_does_not_discredit_the_throttle():
    car = Car()
    car.drive(0.04, 2.0, lie=lambda v: 0.0, seeing=True, disputed=True)
    car.propulsion.confirm()
    assert car.drive(0.04, 1.0, lie=lambda v: 0.0)
