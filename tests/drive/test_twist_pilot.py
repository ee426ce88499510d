"""The pilot of a base that turns on the spot and has a gyro: it arrives, by the same bits again."""

import dataclasses
import math
from pathlib import Path

import numpy as np
import pytest

from jaxnav.core.models.vehicle import TwistBase
from jaxnav.drive.flags import Fault, Health
from jaxnav.drive.interfaces import Odometry, TwistOdometry
from jaxnav.drive.pilot import Input
from jaxnav.files import Route
from jaxnav.recordings.drive_log import read_drive
from jaxnav.recordings.drive_replay import first_difference, replay_drive
from jaxnav.recordings.drive_setup import DriveSetup
from jaxnav.sim.bases import equipped
from jaxnav.vehicles.conformance import injections as inject
from jaxnav.vehicles.conformance.faults import WAYPOINTS_M
from jaxnav.vehicles.conformance.lockstep import BEGIN_NS, Step, drive
from jaxnav.vehicles.world import SimWorld
from tests import worlds
from tests.helpers.simulated import record

# As many waypoints as the fault matrix has, whose program does for these drives as well.
COUNT = len(WAYPOINTS_M)
ROUTE = Route(((1.30, 0.0), *[(0.50, 0.65)] * (COUNT - 1)), 0.15, worlds.START_VIEW)
# Behind it: it turns on the spot, away from the marker.
BEHIND = Route(((2.6, -1.9),) * COUNT, 0.15, worlds.START_VIEW)


def base() -> TwistBase:
    vehicle = equipped(worlds.qcar(), "differential", "consumer")
    assert isinstance(vehicle, TwistBase)
    return vehicle


@pytest.fixture(scope="module")
def setup() -> DriveSetup:
    """One compiled program does for all of it."""
    return DriveSetup(worlds.qcar_rig(), worlds.paper_markers(), base(), ROUTE, float64=True)


def driven(setup: DriveSetup, duration_s: float, happens=lambda now_ns, world: None, **how):
    """A drive in lockstep until it arrives."""
    start = setup.route_on_map.start_pose
    world = SimWorld(setup.rig, setup.markers, setup.vehicle, start, BEGIN_NS)
    steps: list[Step] = []
    for step in drive(setup.pilot(None), world, duration_s, happens=happens, **how):
        steps.append(step)
        if step.outcome.output.done:
            break
    return steps


@pytest.fixture(scope="module")
def steps(setup) -> list[Step]:
    return driven(setup, 12.0)


def flagged(steps: list[Step]) -> Fault:
    """All faults of a drive."""
    faults = Fault(0)
    for step in steps:
        faults |= step.outcome.faults
    return faults


def off_m(steps: list[Step]) -> float:
    """The largest error of a decided pose."""
    decided = [step for step in steps if step.outcome.output.decided]
    return max(math.hypot(*(step.outcome.pose - step.truth[:3])[:2]) for step in decided)


def test_it_finds_out_where_it_is_and_drives_there(steps):
    last = steps[-1]
    assert last.outcome.output.done
    assert math.dist(last.truth[:2], ROUTE.waypoints_m[-1]) < 0.2
    assert flagged(steps) == Fault(0)
    assert off_m(steps) < 0.05
    commands = np.array([step.outcome.command for step in steps])
    assert commands.shape[1] == 3
    assert not commands[:, 1].any()
    assert commands[-1].tolist() == [0.0, 0.0, 0.0]
    assert {(step.outcome.steering_rad, step.outcome.throttle) for step in steps} == {(0.0, 0.0)}


def test_a_turn_on_the_spot_is_motion(setup):
    """Half a turn with the marker in view of one camera after another, and nothing is stuck."""
    steps = driven(dataclasses.replace(setup, route=BEHIND), 12.0)
    assert steps[-1].outcome.output.done
    assert flagged(steps) & ~Fault.NO_MARKER == Fault(0)
    turning = [step for step in steps if abs(step.truth[5]) > 0.5 and abs(step.truth[3]) < 0.05]
    assert len(turning) > 20


def test_the_recorded_drive_replays_to_the_same_states(setup, steps, tmp_path):
    path = Path(tmp_path / "drive.mcap")
    record(path, setup.header(), [(step.input, step.outcome) for step in steps])
    log = read_drive(path)
    assert [given.gyro for given in log.inputs] == [step.input.gyro for step in steps]
    assert [given.odometry for given in log.inputs] == [step.input.odometry for step in steps]
    again = DriveSetup.from_header(log.header, path)
    assert isinstance(again.vehicle, TwistBase)
    outcomes = list(replay_drive(log.inputs, again, None))
    assert first_difference(log, outcomes) is None
    for outcome, step in zip(outcomes, steps, strict=True):
        np.testing.assert_allclose(outcome.pose, step.outcome.pose, rtol=0, atol=1e-9)
        np.testing.assert_allclose(outcome.command, step.outcome.command, rtol=0, atol=1e-9)
    other = dataclasses.replace(outcomes[70], twist=(0.3, 0.0, 0.0))
    changed = [*outcomes[:70], other, *outcomes[71:]]
    assert "twist: off by" in str(first_difference(log, changed))


def gyro(edit):
    """Edit the readings of the gyro from 1 s to 2.5 s on."""

    def change(given: Input) -> list[Input]:
        if 1.0 < (given.now_ns - BEGIN_NS) / 1e9 < 2.5:
            told = tuple(one for reading in given.gyro for one in edit(reading))
            given = dataclasses.replace(given, gyro=told)
        return [given]

    return change


def with_rate(rate):
    return lambda one: [dataclasses.replace(one, turn_radps=rate)]


def late(by_s):
    by_ns = int(by_s * 1e9)
    return lambda one: [dataclasses.replace(one, stamp_ns=one.stamp_ns - by_ns)]


@pytest.mark.parametrize(
    ("edit", "faults"),
    [
        (with_rate(-0.25), Fault.GYRO_INVALID | Fault.GYRO_STALE),  # it repeats itself
        *(
            pytest.param(*case, marks=pytest.mark.long)
            for case in (
                (late(2.0), Fault.STAMP_INVALID | Fault.GYRO_STALE | Fault.CLOCK_JUMPED),
                (lambda one: [], Fault.GYRO_STALE),
                (with_rate(math.nan), Fault.GYRO_INVALID | Fault.GYRO_STALE),
                (lambda one: [one, one], Fault.STAMP_INVALID),
            )
        ),
    ],
)
def test_a_gyro_that_fails_is_named_and_the_drive_goes_on_without(setup, edit, faults):
    steps = driven(setup, 12.0, change=gyro(edit))
    assert flagged(steps) == faults
    assert steps[-1].outcome.output.done
    assert off_m(steps) < 0.08
    assert {step.outcome.health for step in steps[-20:]} == {Health.OK}
    assert not steps[-1].outcome.faults


@pytest.mark.long
def test_a_wheel_that_runs_away_is_refused(setup):
    """Ten times the turn rate for half a second, then nothing for half a second."""

    def change(given: Input) -> list[Input]:
        read, time_s = given.odometry, (given.now_ns - BEGIN_NS) / 1e9
        if isinstance(read, TwistOdometry) and 1.5 < time_s < 2.0:
            wrong = dataclasses.replace(read, turn_radps=30.0)
            return [dataclasses.replace(given, odometry=wrong)]
        return [] if read is not None and 2.0 < time_s < 2.5 else [given]

    steps = driven(setup, 12.0, change=change)
    assert Fault.ODOMETRY_STALE in flagged(steps)
    assert steps[-1].outcome.output.done
    assert off_m(steps) < 0.08


def test_who_is_held_fast_stands_still(setup):
    """Its wheels are told to turn it and do not: it gives up, with zeros as its last words."""
    held = dataclasses.replace(setup, route=BEHIND)
    steps = driven(held, 3.5, lambda now_ns, world: world.hold(now_ns > BEGIN_NS + 10**9))
    last = steps[-1].outcome
    assert Fault.NOTHING_MOVES in last.faults
    assert (last.health, last.command) == (Health.STOP, (0.0, 0.0, 0.0))


BAD = [
    TwistOdometry(BEGIN_NS, math.nan, 0.0, 0.0),
    TwistOdometry(BEGIN_NS, 0.0, math.inf, 0.0),
    TwistOdometry(BEGIN_NS, 1e308, 0.0, 0.0),
    TwistOdometry(BEGIN_NS, 0.0, 0.0, 1e30),
    TwistOdometry(BEGIN_NS, 0.0, 0.0, 0.0, valid=False),
    Odometry(BEGIN_NS, 0.1, 0.0),  # a car's
]


@pytest.mark.parametrize("reading", BAD)
def test_what_is_no_twist_is_not_fused(setup, steps, reading):
    pilot = setup.pilot(None)
    told = dataclasses.replace(reading, stamp_ns=BEGIN_NS)
    outcome = pilot.handle(Input(BEGIN_NS, told))
    assert Fault.ODOMETRY_INVALID in outcome.faults
    assert outcome.data is None
    assert outcome.command == (0.0, 0.0, 0.0)


def test_corners_that_rest_while_it_turns_are_a_frozen_camera(setup):
    frozen = inject.between(1.5, math.inf, inject.frames(inject.frozen(range(4), 0.1)))
    steps = driven(dataclasses.replace(setup, route=BEHIND), 3.0, change=frozen)
    assert Fault.FRAME_FROZEN in flagged(steps)
