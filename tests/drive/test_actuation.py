"""Commands against the motion that follows: what is wired wrongly is named, and nothing else is."""

import math
from dataclasses import dataclass, field

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from jaxnav.drive.actuation import DOUBT_M, Actuation, Propulsion
from jaxnav.drive.chassis import BaseChassis, CarChassis, car_motion
from jaxnav.drive.flags import Fault
from jaxnav.drive.limits import Limits, TwistLimits
from jaxnav.drive.ways import Fix

CAR = CarChassis(Limits(0.5, 5.0, 0.3), (3.0,), 0.3, 10.0, 0.256)
OMNI = BaseChassis(TwistLimits(1.0, 1.0, 7.0), 0.15, 1 / 7)
DIFFERENTIAL = BaseChassis(TwistLimits(1.0, 0.0, 7.0), 0.15, 1 / 7)
PERIOD_NS = 33_333_333


@dataclass
class Truth:
    """A vehicle that is as far from its file as one may be, and noisy fixes of it."""

    chassis: CarChassis | BaseChassis
    rng: np.random.Generator
    acts: object = staticmethod(lambda command: command)
    pose: np.ndarray = field(default_factory=lambda: np.zeros(3))
    way_m: float = 0.0

    def __post_init__(self):
        parts = len(self.chassis.parts)
        spread = 0.3 if isinstance(self.chassis, CarChassis) else 0.1
        self.gains = 1 + np.clip(spread * self.rng.standard_normal(parts), -2 * spread, 2 * spread)
        if parts == 2:
            self.gains[1] = 1 + 0.1 * self.rng.uniform(-1, 1)
        self.offset_rad = np.deg2rad(1.5) * self.rng.uniform(-1, 1) * (parts == 2)
        self.late = int(self.rng.integers(0, 4))  # periods: up to 0.1 s
        self.lag_s = self.rng.uniform(0.5, 1.5) * self.chassis.time_constant_s
        self.waiting = [self.chassis.limits.zero] * self.late
        self.rates = np.zeros(3)
        self.bias = np.zeros(3)

    def go(self, command: tuple[float, ...], gap_s: float) -> Fix:
        self.waiting.append(self.acts(command))
        obeyed = self.waiting.pop(0)
        done = 1 - math.exp(-gap_s / self.lag_s)
        if len(obeyed) == 2:
            speed = self.gains[0] * self.chassis.wanted_mps(obeyed)[0]
            self.rates[0] += done * (speed - self.rates[0])
            steering = self.gains[1] * obeyed[0] + self.offset_rad
            moved = car_motion(self.rates[0], steering, self.chassis.wheelbase_m)
        else:
            self.rates += done * (self.gains * obeyed - self.rates)
            moved = self.rates
        middle = self.pose[2] + moved[2] * gap_s / 2
        c, s = math.cos(middle), math.sin(middle)
        before = self.pose.copy()
        self.pose += gap_s * np.array(
            [c * moved[0] - s * moved[1], s * moved[0] + c * moved[1], moved[2]]
        )
        moves = np.abs(self.pose - before)
        self.way_m += math.hypot(moves[0], moves[1]) + self.chassis.lever_m * moves[2]
        # What is wrong with corners for some seconds, and from frame to frame.
        sigma = np.array([0.01, 0.01, 0.01])
        self.bias += sigma * (self.rng.standard_normal(3) * 0.18 - self.bias / sigma * 0.016)
        noise = self.bias + 0.5 * sigma * self.rng.standard_normal(3)
        return Fix(*(self.pose + noise).tolist(), 0.01, 0.01)


def commands(chassis, rng):
    """A new one every half second: what a route full of turns asks for."""
    while True:
        if isinstance(chassis, CarChassis):
            told = rng.uniform(-0.5, 0.5), rng.choice([0.03, 0.05, 0.1, -0.05])
        else:
            left = chassis.limits.left_mps and rng.uniform(-0.5, 0.5)
            told = rng.uniform(-0.5, 0.5), left, rng.uniform(-2, 2)
        yield from [told] * 15


def used(chassis, rng):
    """A new one every second, in which each part is used: nothing shows of one that is not."""
    while True:
        if isinstance(chassis, CarChassis):
            told = rng.choice([-1, 1]) * rng.uniform(0.2, 0.5), 0.05
        elif chassis is OMNI:
            along, aside = rng.permutation([rng.uniform(0.4, 0.5), rng.uniform(0.1, 0.2)])
            told = rng.choice([-1, 1]) * along, rng.choice([-1, 1]) * aside, 0.0
        else:
            told = 0.4, 0.0, rng.choice([-1, 1]) * rng.uniform(0.5, 1.5)
        yield from [told] * 30


def drive(chassis, seed, duration_s, acts=lambda command: command, commands=commands):
    """The first fault and the way until then, and until it gives up."""
    rng = np.random.default_rng(seed)
    truth, actuation = Truth(chassis, rng, acts), Actuation(chassis)
    told = commands(chassis, rng)
    named, named_m, gave_up_m = Fault(0), math.inf, math.inf
    for index in range(int(duration_s * 30)):
        command = next(told)
        actuation.add_command(command, PERIOD_NS / 1e9)
        actuation.add_fix(index * PERIOD_NS, truth.go(command, PERIOD_NS / 1e9))
        if actuation.faults and math.isinf(named_m):
            named, named_m = actuation.faults, truth.way_m
        if actuation.gives_up:
            gave_up_m = min(gave_up_m, truth.way_m)
    return named, named_m, gave_up_m


@pytest.mark.parametrize("chassis", [CAR, OMNI, DIFFERENTIAL], ids=["car", "omni", "differential"])
def test_nothing_that_a_sound_vehicle_does_is_a_contradiction(chassis):
    assert [drive(chassis, seed, 15.0)[0] for seed in range(10)] == [Fault(0)] * 10


AHEAD, ASIDE, TURN = Fault.DRIVE_CONTRADICTED, Fault.SIDEWAYS_CONTRADICTED, Fault.TURN_CONTRADICTED


@pytest.mark.parametrize(
    ("chassis", "acts", "fault"),
    [
        (CAR, lambda c: (-c[0], c[1]), TURN),
        (CAR, lambda c: (c[0], -c[1]), AHEAD),
        (OMNI, lambda c: (-c[0], c[1], c[2]), AHEAD),
        (OMNI, lambda c: (c[0], -c[1], c[2]), ASIDE),
        (OMNI, lambda c: (c[1], c[0], c[2]), AHEAD | ASIDE),
        (DIFFERENTIAL, lambda c: (c[0], c[1], -c[2]), TURN),
    ],
)
def test_what_is_wired_wrongly_is_named_soon_and_stands(chassis, acts, fault):
    for seed in range(10):
        named, named_m, gave_up_m = drive(chassis, seed, 5.0, acts, used)
        assert named & fault
        assert named_m < 0.5
        assert gave_up_m < 1.0


@pytest.mark.parametrize(("at_rad", "within_m"), [(0.0, 0.75), (0.3, 1.75)])
def test_a_dead_servo_is_named_once_something_else_is_commanded(at_rad, within_m):
    """Every other second by chance, and then not by much."""
    for seed in range(10):
        named, named_m, _ = drive(CAR, seed, 5.0, lambda c: (at_rad, c[1]), used)
        assert named == TURN
        assert named_m < within_m


def test_headings_of_one_frame_that_are_unsure_turn_no_vehicle():
    """As of a marker far off, while the estimate of a drive that has just begun is corrected."""
    actuation = Actuation(CAR)
    for index in range(30):
        now_ns, psi_rad = index * PERIOD_NS, 0.01 * index
        actuation.add_command((0.3, 0.05), PERIOD_NS / 1e9)
        off_rad = {15: 0.1, 16: 0.2}.get(index)
        if off_rad:
            actuation.add_headings(now_ns, [(psi_rad + off_rad, 0.15)])
        else:
            actuation.add_fix(now_ns, Fix(0.02 * index, 0.0, psi_rad, 0.05, 0.02))
    assert not actuation.faults


def test_a_leap_of_what_was_hardly_known_is_no_motion():
    actuation = Actuation(CAR)
    for index in range(20):
        psi_rad, sigma_rad = (0.2, 0.1) if index < 10 else (0.0, 0.02)
        actuation.add_command((0.0, 0.05), PERIOD_NS / 1e9)
        actuation.add_fix(index * PERIOD_NS, Fix(0.02 * index, 0.0, psi_rad, 0.05, sigma_rad))
    assert not actuation.faults


PER_THROTTLE, LAG_S, GAP_S = 10.0, 0.3, 0.02


class Throttled:
    """A car with a lag of first order, whose odometer can lie."""

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


throttles = st.lists(st.tuples(st.floats(-0.3, 0.3), st.floats(0.02, 1.0)), max_size=20)


@given(throttles, st.floats(0.6, 1.7), st.floats(0.6, 1.7))
def test_a_car_as_its_file_says_within_a_factor_is_believed(told, gain, slower):
    car = Throttled(gain, slower * LAG_S)
    assert not any(car.drive(throttle, seconds) for throttle, seconds in told)


@pytest.mark.parametrize("by", [0.0, 0.3, 3.0, -1.0])
def test_what_the_throttle_contradicts_is_doubted_until_corners_confirm(by):
    car = Throttled()
    assert not car.drive(0.04, 2.0)
    assert car.drive(0.04, 0.6, lie=lambda v: by * v)
    off_m = car.propulsion.off_m
    assert off_m > DOUBT_M
    assert car.drive(0.04, 2.0)  # it does not tell by itself whether it was right
    assert car.propulsion.off_m == pytest.approx(off_m, abs=0.02)
    car.propulsion.confirm()
    assert not car.drive(0.04, 2.0)
    assert not car.drive(0.0, 3.0, lie=lambda v: 0.0)  # brakes may act at once


def test_a_throttle_that_moves_nothing_while_corners_agree_says_nothing():
    """A recorded drive, a car that is pushed."""
    car = Throttled()
    car.drive(0.0, 1.0, lie=lambda v: 0.5, seeing=True)
    car.propulsion.confirm()
    assert not car.drive(0.0, 3.0, lie=lambda v: 0.5)
    car.drive(0.04, 2.0, seeing=True)
    car.propulsion.confirm()
    assert car.drive(0.04, 1.0, lie=lambda v: 0.0)


def test_an_odometer_that_the_corners_dispute_does_not_discredit_the_throttle():
    car = Throttled()
    car.drive(0.04, 2.0, lie=lambda v: 0.0, seeing=True, disputed=True)
    car.propulsion.confirm()
    assert car.drive(0.04, 1.0, lie=lambda v: 0.0)
