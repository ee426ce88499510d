"""Motion of cars and other bases: what is driven, what moves, and what no wheel can do."""

import math

import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from jaxnav.core.models.vehicle import TwistBase, velocity_world
from jaxnav.drive.chassis import BaseChassis, CarChassis, Motion, chassis_of, pace_mps
from jaxnav.drive.flags import Fault
from jaxnav.drive.interfaces import Odometry, TwistOdometry
from jaxnav.drive.odometer import Odometers
from jaxnav.drive.standstill import Standstill, Way
from jaxnav.drive.support import Support
from jaxnav.drive.ways import Fix, Ways
from tests import worlds

MS = 1_000_000
BEGIN_NS = 10**12
SPIN_RADPS = 2.0


@pytest.fixture(scope="module")
def base() -> BaseChassis:
    """Half of its track width is 0.25 m."""
    chassis = chassis_of(TwistBase.create(1.0, 4.0, 0.15, left_limit_mps=0.5))
    assert isinstance(chassis, BaseChassis)
    return chassis


@pytest.fixture(scope="module")
def car() -> CarChassis:
    chassis = chassis_of(worlds.qcar())
    assert isinstance(chassis, CarChassis)
    return chassis


def test_a_car_is_driven_by_its_throttle_and_moves_as_the_bicycle_does(car):
    reading = Odometry(0, 0.7, 0.3)
    assert car.driven_mps(reading) == (0.7,)
    assert car.wanted_mps((0.3, 0.1)) == (pytest.approx(0.1 * car.speed_per_throttle_mps),)
    expected = velocity_world(*map(jnp.asarray, (0.7, 0.3, 0.0, car.wheelbase_m)))
    np.testing.assert_allclose(car.motion(reading), expected)
    velocity, covariance = np.array([-0.3, -0.4, 0.2]), np.diag([9e-4, 16e-4, 1.0])
    believed = car.believed_mps(0.0, velocity, covariance)
    np.testing.assert_allclose(believed, [(-0.5, 0.05)])


def test_a_base_has_three_driven_parts_and_its_rim_goes_as_fast_as_it_turns(base):
    reading = TwistOdometry(0, 0.3, -0.2, SPIN_RADPS)
    assert base.driven_mps(reading) == base.wanted_mps((0.3, -0.2, SPIN_RADPS)) == (0.3, -0.2, 0.5)
    assert base.tops_mps == (1.0, 0.5, 1.0)
    assert base.motion(reading) == Motion(0.3, -0.2, SPIN_RADPS)
    assert pace_mps((0.3, -0.4, -0.5)) == pytest.approx(1.0)
    velocity, covariance = np.array([-0.3, 0.2, 1.0]), np.diag([9e-4, 16e-4, 0.04])
    believed = base.believed_mps(math.pi / 2, velocity, covariance)
    np.testing.assert_allclose(believed, [(0.2, 0.05), (0.3, 0.05), (0.25, 0.05)], atol=1e-12)


@given(st.tuples(st.floats(), st.floats(), st.floats()))
def test_a_reading_is_one_that_a_vehicle_can_have(car, base, values):
    speed_mps, other, _ = values
    told = Odometry(0, speed_mps, other)
    most = 1e3 * (1 + 1e-6), 63 * (1 + 1e-6)  # see `Range.holds`
    assert car.reads(told) == bool(abs(speed_mps) <= most[0] and abs(other) <= most[1])
    assert not base.reads(told)
    if car.reads(told):
        assert all(map(math.isfinite, car.motion(told)))
    told = TwistOdometry(0, *values)
    assert base.reads(told) == all(abs(value) <= most[0] for value in values)
    assert not car.reads(told)


class Wheels:
    """Readings of a base every 20 ms, with a lag of first order."""

    def __init__(self, base):
        self.base, self.odometers = base, Odometers(base)
        self.twist, self.stamp_ns, self.count = np.zeros(3), BEGIN_NS, 0

    def tell(self, command, lie=lambda twist: twist) -> tuple[bool, Fault]:
        self.stamp_ns += 20 * MS
        self.count += 1
        self.twist += (np.array(command) - self.twist) * (1 - math.exp(-0.02 / 0.15))
        told = lie(self.twist)
        reading = TwistOdometry(self.stamp_ns, *(told + 1e-9 * self.count * (told != 0)).tolist())
        return self.odometers.judge(
            self.base.driven_mps(reading), reading.values, self.stamp_ns,
            None, False, self.base.wanted_mps(command), False,
        )  # fmt: skip


def test_what_a_command_can_do_is_believed(base):
    wheels, command = Wheels(base), (0.5, -0.4, 1.0)
    assert all(wheels.tell(command) == (True, Fault(0)) for _ in range(60))
    assert all(wheels.tell((0.0, 0.0, 0.0)) == (True, Fault(0)) for _ in range(60))


@pytest.mark.parametrize("part", range(3))
def test_one_part_that_runs_away_is_refused_and_the_next_is_believed(base, part):
    wheels, away = Wheels(base), np.eye(3)[part] * 8.0
    for _ in range(30):
        wheels.tell((0.2, 0.0, 1.0))
    for _ in range(3):
        assert wheels.tell((0.2, 0.0, 1.0), lambda twist: twist + away) == (False, Fault(0))
        assert wheels.tell((0.2, 0.0, 1.0)) == (True, Fault(0))


def test_a_turn_that_stays_while_it_is_told_to_end_is_stuck(base):
    wheels = Wheels(base)
    for _ in range(40):
        wheels.tell((0.0, 0.0, 2.0))
    turned = np.array([0.0, 0.0, 1.9])
    for step in range(40):
        stamp_ns = wheels.stamp_ns + (step + 1) * 20 * MS
        reading = TwistOdometry(stamp_ns, *turned.tolist())
        parts = base.driven_mps(reading), reading.values
        told = wheels.odometers.judge(*parts, stamp_ns, None, False, (0.0, 0.0, 0.0))
    assert told == (False, Fault.ODOMETRY_STUCK)


def turn(standstill, base, seconds, told_radps, command_radps, now_ns):
    """A turn on the spot, of which no camera sees anything."""
    for _ in range(round(seconds / 0.02)):
        now_ns += 20 * MS
        reading = TwistOdometry(now_ns, 0.0, 0.0, told_radps)
        pace = pace_mps(base.driven_mps(reading))
        standstill.add_reading(now_ns, now_ns, pace)
        standstill.add_believed(now_ns, now_ns, pace, base.motion(reading))
        standstill.add_command(base.wanted_mps((0.0, 0.0, command_radps)), now_ns)
    return now_ns


def test_a_turn_on_the_spot_is_motion_and_one_that_does_not_come_is_none(base):
    standstill = Standstill(Way(base.lever_m), base.time_constant_s)
    now_ns = turn(standstill, base, 5.0, SPIN_RADPS, SPIN_RADPS, BEGIN_NS)
    assert not standstill.nothing_moves
    now_ns = turn(standstill, base, 2.0, 0.0, SPIN_RADPS, now_ns)
    assert standstill.nothing_moves
    turn(standstill, base, 0.1, SPIN_RADPS, 0.0, now_ns)
    assert not standstill.nothing_moves


@given(st.floats(-0.5, 0.5), st.floats(-0.5, 0.5), st.floats(-3, 3))
def test_the_way_of_a_twist_is_an_arc(forward, left, turn_radps):
    way = Way()
    for step in range(51):
        way.go(BEGIN_NS + step * 20 * MS, Motion(forward, left, turn_radps))
    x_m, y_m, psi_rad = way.at(BEGIN_NS + 1000 * MS)
    assert psi_rad == pytest.approx(turn_radps)
    assert Way(0.25).length_m((0.0, 0.0, psi_rad)) == pytest.approx(0.25 * abs(turn_radps))
    chord = np.sinc(turn_radps / 2 / np.pi)
    c, s = math.cos(turn_radps / 2), math.sin(turn_radps / 2)
    expected = chord * (c * forward - s * left), chord * (s * forward + c * left)
    assert (x_m, y_m) == pytest.approx(expected, abs=1e-3)


def test_who_has_turned_may_face_elsewhere_and_be_a_little_off(base):
    ways, here = Ways(base.slides_m), Fix(0.0, 0.0, 0.0, 0.005, 0.005)
    ways.note_corners(BEGIN_NS)
    ways.add_fix(BEGIN_NS, here)
    assert ways.out_of_reach(here._replace(psi_rad=3.0))
    for _ in range(50):
        ways.add_odometry(Motion(0.0, 0.0, SPIN_RADPS), 0.5, 0.0, 0.02)
    assert ways.way_m == pytest.approx(0.5)
    assert not ways.out_of_reach(here._replace(psi_rad=2.0))
    assert not ways.out_of_reach(here._replace(x_m=0.4))
    assert ways.out_of_reach(here._replace(x_m=1.0))


def test_wheels_that_do_not_turn_it_are_doubted_where_no_marker_is_in_view(base):
    support = Support(base)
    commanded = base.wanted_mps((0.0, 0.0, SPIN_RADPS))
    for _ in range(50):
        motion = Motion(0.0, 0.0, SPIN_RADPS)
        support.add_odometry(commanded, motion, 0.0, 0.02, commanded, False)
    assert Fault.ODOMETRY_DOUBTFUL not in support.faults
    for _ in range(50):
        support.add_odometry((0.0, 0.0, 0.0), Motion(0.0, 0.0, 0.0), 0.0, 0.02, commanded, False)
    assert Fault.ODOMETRY_DOUBTFUL in support.faults
