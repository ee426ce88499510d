"""The command is always finite and inside the limits (docs/promises.md, It stops)."""

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from jaxnav.core.models.vehicle import TwistBase
from jaxnav.drive.limits import Limits, TwistLimits, limits_of
from tests import worlds

LIMITS = Limits(steering_rad=0.5, steering_rate_radps=5.0, throttle=0.3)
BASE = TwistLimits(forward_mps=1.0, left_mps=0.5, turn_radps=3.0)
anything = st.floats() | st.integers(-(10**300), 10**300)


@given(anything, anything, anything, anything)
def test_any_command_is_finite_and_inside_the_limits(steering, throttle, last, elapsed_s):
    told_rad, told = LIMITS.within((steering, throttle), (last, 0.0), elapsed_s)
    assert abs(told_rad) <= LIMITS.steering_rad
    assert abs(told) <= LIMITS.throttle
    if not (math.isfinite(steering) and math.isfinite(throttle)):
        assert told == 0
    inside = told_rad, told
    assert LIMITS.within(inside, (0.0, 0.0), 1.0) == inside


@given(st.floats(), st.floats(-0.5, 0.5), st.floats(0, 1))
def test_the_steering_moves_no_faster_than_it_may(steering, last, elapsed_s):
    told_rad, _ = LIMITS.within((steering, 0.1), (last, 0.0), elapsed_s)
    assert abs(told_rad - last) <= 5.0 * elapsed_s + 1e-12


@pytest.mark.parametrize("elapsed_s", [0.0, -1.0, math.nan, -math.inf])
def test_without_a_time_that_went_by_the_steering_stays(elapsed_s):
    assert LIMITS.within((0.4, 0.1), (0.2, 0.0), elapsed_s) == (0.2, 0.1)


def test_the_limits_are_the_vehicles():
    vehicle = worlds.qcar()
    limits = Limits.from_vehicle(vehicle)
    assert (limits.steering_rad, limits.throttle) == (0.5, float(vehicle.throttle_limit))
    assert limits.steering_rate_radps == float(vehicle.steering_rate_limit_radps)


@given(st.tuples(anything, anything, anything), st.floats())
def test_any_twist_is_cut_at_each_limit_and_one_that_is_no_number_is_zero(command, elapsed_s):
    told = BASE.within(command, (0.0, 0.0, 0.0), elapsed_s)
    if not all(map(math.isfinite, command)):
        assert told == (0.0, 0.0, 0.0)
        return
    for part, limit, wanted in zip(told, (1.0, 0.5, 3.0), command, strict=True):
        assert part == (wanted if abs(wanted) <= limit else math.copysign(limit, wanted))


def test_the_limits_of_a_base_are_the_files():
    base = TwistBase.create(1.2, 3.0, 0.1, left_limit_mps=0.7)
    assert limits_of(base) == TwistLimits(*map(float, (base.limits)))
