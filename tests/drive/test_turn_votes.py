"""Of gyro, wheels and corners the gyro is named where the two others agree, and only there."""

import math

import numpy as np
import pytest

from jaxnav.drive.chassis import Motion
from jaxnav.drive.turn_votes import TurnVotes
from tests.drive.test_actuation import CAR, DIFFERENTIAL, PERIOD_NS, Truth, commands

BIAS_RADPS = 0.01
SOUND = "sound"
LIES = {
    "stuck at 0": lambda rate: 0.0,
    "of the wrong sign": lambda rate: -rate,
    "in degrees": math.degrees,
}


def drive(chassis, seed, duration_s, lie=SOUND, dark=lambda time_s: False, turns=1.0):
    """The way until the gyro is named, inf: never.

    Args:
        dark: when no marker is seen.
        turns: what the wheels multiply the turn by.
    """
    rng = np.random.default_rng(seed)
    truth, told = Truth(chassis, rng), commands(chassis, rng)
    rates: dict[int, float] = {}
    votes = TurnVotes(chassis, BIAS_RADPS, lambda begin, end: mean(rates, begin, end))
    bias, scale = BIAS_RADPS * rng.uniform(-2, 2), rng.uniform(0.97, 1.03)
    wheels = turns * rng.uniform(0.95, 1.05)
    for index in range(int(duration_s * 30)):
        now_ns, gap_s, command = index * PERIOD_NS, PERIOD_NS / 1e9, next(told)
        before = truth.pose[2]
        fix = truth.go(command, gap_s)
        rate = (truth.pose[2] - before) / gap_s
        read = rate if lie == SOUND else LIES[lie](rate)
        rates[index] = scale * read + bias + 0.02 * rng.standard_normal()
        votes.add_command(command, gap_s)
        moved = np.array(truth.rates)
        if chassis is CAR:
            moved = np.array([truth.rates[0], 0.0, 0.0])
        moved[2] = wheels * rate + 0.02 * moved[0]
        votes.add_reading(now_ns, Motion(*moved.tolist()))
        if not dark(now_ns / 1e9):
            votes.add_fix(now_ns, fix.psi_rad)
        if votes.gyro_is_wrong:
            return truth.way_m
    return math.inf


def mean(rates, begin_ns, end_ns):
    between = range(begin_ns // PERIOD_NS + 1, end_ns // PERIOD_NS + 1)
    return float(np.mean([rates[index] for index in between]))


BOTH = pytest.mark.parametrize("chassis", [CAR, DIFFERENTIAL], ids=["car", "base"])


@BOTH
@pytest.mark.parametrize("turns", [1.0, 1.5, -1.0], ids=["sound", "sliding", "reversed"])
def test_a_sound_gyro_is_never_named(chassis, turns):
    """Whatever the wheels tell, with the marker in view; without one, while they are sound."""
    gap = (lambda s: False) if turns < 0 else (lambda s: 4.0 < s < 8.0)
    ways_m = [drive(chassis, seed, 12.0, dark=gap, turns=turns) for seed in range(10)]
    assert ways_m == [math.inf] * 10


@BOTH
@pytest.mark.parametrize("lie", LIES)
@pytest.mark.parametrize("dark", [False, True], ids=["seeing", "blind"])
def test_one_that_lies_is_named(chassis, lie, dark):
    ways_m = [drive(chassis, seed, 10.0, lie, lambda s: dark) for seed in range(10)]
    assert max(ways_m) < (1.5 if dark else 1.0)


def test_it_takes_more_than_a_little_to_blame_a_gyro():
    """Blind, while the wheels count too much and the vehicle turns hardly less than it might."""
    least = 1 / DIFFERENTIAL.parts[-1].factor
    votes = TurnVotes(DIFFERENTIAL, BIAS_RADPS, lambda begin_ns, end_ns: 0.93 * least)
    for index in range(40):
        votes.add_command((0.0, 0.0, 1.0), PERIOD_NS / 1e9)
        votes.add_reading(index * PERIOD_NS, Motion(0.0, 0.0, 1.3))
    assert votes._gyro_wheels.most > 0.1
    assert not votes.gyro_is_wrong
