"""The pilot, from events to commands: reproducible, for any order of events and any data."""

import dataclasses
import math

import jax
import numpy as np
import pytest
from hypothesis import given as drawn
from hypothesis import settings
from hypothesis import strategies as st

from jaxnav.core.navigator import Navigator
from jaxnav.detection.types import Detections
from jaxnav.drive.estimator import Estimator
from jaxnav.drive.flags import Fault, Health, Reject
from jaxnav.drive.frames import FrameDetections
from jaxnav.drive.history import EventData
from jaxnav.drive.interfaces import Odometry
from jaxnav.drive.pilot import Input, Outcome, Pilot
from jaxnav.recordings.drive_setup import DriveSetup
from jaxnav.recordings.records import digest
from jaxnav.vehicles.conformance import injections as inject
from jaxnav.vehicles.conformance.lockstep import BEGIN_NS, Rates, Step, drive
from jaxnav.vehicles.world import SimWorld
from tests import worlds
from tests.helpers.simulated import make_setup, simulated

MS = 1_000_000


@pytest.fixture(scope="module")
def setup() -> DriveSetup:
    return make_setup()


@pytest.fixture(scope="module")
def steps(setup) -> list[Step]:
    """Two and a half seconds: it finds out where it is, and drives."""
    return simulated(setup, 2.5)


@pytest.fixture(scope="module")
def inputs(steps) -> list[Input]:
    return [step.input for step in steps]


def handled(setup: DriveSetup, inputs: list[Input]) -> tuple[Pilot, list[Outcome]]:
    pilot = setup.pilot(None)
    return pilot, [pilot.handle(given) for given in inputs]


def assert_same_belief(one: Outcome, other: Outcome, atol: float) -> None:
    """Of their moments; a bank's empty slots hold anything."""
    alive = one.belief.bank.initialised
    np.testing.assert_array_equal(other.belief.bank.initialised, alive)
    for name in ("mean", "covariance", "log_weight"):
        before, after = (getattr(o.belief.bank, name)[alive] for o in (one, other))
        np.testing.assert_allclose(after, before, atol=atol, rtol=0, err_msg=name)
    assert one.belief.decided == other.belief.decided


def test_the_car_finds_out_where_it_is_and_drives(steps):
    last = steps[-1]
    assert last.outcome.health == Health.OK
    assert last.outcome.faults == Fault(0)
    assert np.hypot(*(last.outcome.output.pose - last.truth[:3])[:2]) < 0.02
    assert last.truth[3] > 0.1
    assert {step.outcome.restarts for step in steps} == {0}


def test_the_same_inputs_give_the_same_bits(setup, steps, inputs):
    _, again = handled(setup, inputs)
    assert [digest(outcome) for outcome in again] == [digest(step.outcome) for step in steps]


def test_where_somebody_else_drives_it_only_localises(setup, steps, inputs):
    """Nor does it doubt an odometer that its own throttle, which is zero, can't explain."""
    _, outcomes = handled(dataclasses.replace(setup, drives=False), inputs)
    assert {(outcome.steering_rad, outcome.throttle) for outcome in outcomes} == {(0.0, 0.0)}
    assert [outcome.rejects for outcome in outcomes] == [step.outcome.rejects for step in steps]
    assert [outcome.faults for outcome in outcomes] == [step.outcome.faults for step in steps]
    assert_same_belief(outcomes[-1], steps[-1].outcome, 0.0)


def test_odometry_means_the_same_to_the_program_without_cameras(setup, steps, inputs, monkeypatch):
    """Nobody can tell which of the two was called."""
    seeing = Estimator._events
    monkeypatch.setattr(Estimator, "_events", lambda self, *told: seeing(self, *told[:-1], True))
    _, always = handled(setup, inputs)
    for outcome, step in zip(always, steps, strict=True):
        assert_same_belief(outcome, step.outcome, atol=1e-9)


def test_to_warm_up_leaves_no_trace(setup, steps, inputs):
    pilot = setup.pilot(None)
    pilot.warm_up()
    assert digest(pilot.handle(inputs[0])) == digest(steps[0].outcome)


def test_pilots_of_a_setup_share_one_program(setup, tmp_path):
    """Each that is loaded takes over 100 MB, and a node makes a pilot at every reset."""
    programs = [setup.pilot(folder)._estimator._program for folder in (None, None, *[tmp_path] * 2)]
    assert programs[0] is programs[1]
    assert programs[2] is programs[3]
    assert dataclasses.replace(setup).pilot(None)._estimator._program is not programs[0]


def _stamp_ns(given: Input) -> int:
    return given.frames[0].stamp_ns if given.frames else given.odometry.stamp_ns


@pytest.mark.parametrize("delay_ns", [-30 * MS, 300 * MS])
def test_late_frames_tell_the_same_as_frames_in_time(setup, inputs, delay_ns):
    """From a second on every frame, which is 30 ms old, comes so much later: -30: in order."""
    late = [
        dataclasses.replace(given, now_ns=given.now_ns + delay_ns)
        if given.frames and given.now_ns > BEGIN_NS + 1_000 * MS
        else given
        for given in inputs[:130]
    ]
    late.sort(key=lambda given: given.now_ns)
    stamps_ns = [_stamp_ns(given) for given in late]
    assert stamps_ns != [_stamp_ns(given) for given in inputs[:130]]
    assert (stamps_ns[90:] == sorted(stamps_ns[90:])) == (delay_ns < 0)
    end = Input(inputs[170].now_ns)
    _, one = handled(setup, [*inputs[:130], end])
    _, other = handled(setup, [*late, end])
    assert {outcome.rejects for outcome in other} == {Reject(0)}
    assert bool(one[-1].output.decided)
    assert_same_belief(one[-1], other[-1], atol=1e-9)
    np.testing.assert_allclose(one[-1].output.pose, other[-1].output.pose, atol=1e-9)


def test_what_takes_several_calls_tells_the_same_as_one(setup, inputs, monkeypatch):
    """Every third frame comes so late that it is fused in parts of three events."""
    late = [
        dataclasses.replace(given, now_ns=given.now_ns + 300 * MS)
        if given.frames and index % 3 == 0 and index > 40
        else given
        for index, given in enumerate(inputs[:130])
    ]
    late.sort(key=lambda given: given.now_ns)
    _, one = handled(setup, late)
    pilot = setup.pilot(None)
    monkeypatch.setattr("jaxnav.drive.estimator.EVENTS", 4)
    other = [pilot.handle(given) for given in late]
    assert {outcome.rejects for outcome in other} <= {Reject(0), Reject.INNOVATION_LARGE}
    for a, b in zip(one, other, strict=True):
        for name in ("nis", "selected", "costs", "pose"):
            first, second = getattr(a.output, name), getattr(b.output, name)
            np.testing.assert_allclose(first, second, atol=1e-9, rtol=1e-9)
        assert (a.steering_rad, a.throttle) == pytest.approx((b.steering_rad, b.throttle), abs=1e-9)
    assert_same_belief(one[-1], other[-1], atol=1e-9)


def test_a_camera_whose_frames_are_too_late_for_the_filter_is_stale(setup, inputs):
    pilot = setup.pilot(None)
    pilot.handle(inputs[0])
    given = next(given for given in inputs if given.frames)
    early_ns = inputs[0].now_ns - MS  # before all that was told
    told = [dataclasses.replace(frame, stamp_ns=early_ns) for frame in given.frames]
    outcome = pilot.handle(Input(inputs[0].now_ns + 250 * MS, frames=tuple(told)))
    assert Reject.TOO_LATE in outcome.rejects
    assert Fault.CAMERAS_STALE in outcome.faults


def test_a_tick_changes_nothing_of_what_is_believed(setup, steps, inputs):
    with_ticks, steps = [], steps[60:110]
    for given in inputs[60:110]:
        with_ticks += [given, Input(given.now_ns), Input(given.now_ns)]
    _, outcomes = handled(setup, [*inputs[:60], *with_ticks])
    outcomes = outcomes[60:]
    for event, tick, step in zip(outcomes[::3], outcomes[1::3], steps, strict=True):
        for other in (event, tick):
            same = jax.tree.map(np.array_equal, other.belief, step.outcome.belief)
            assert all(jax.tree.leaves(same))
    np.testing.assert_array_equal(outcomes[-1].output.pose, outcomes[-3].output.pose)


def test_while_nothing_comes_the_pose_goes_on(setup, inputs):
    pilot, outcomes = handled(setup, inputs)
    later = pilot.handle(Input(inputs[-1].now_ns + 500 * MS))
    moved_m = np.hypot(*(later.output.pose - outcomes[-1].output.pose)[:2])
    assert 0.05 < moved_m < 1.0
    assert np.trace(later.output.covariance) > np.trace(outcomes[-1].output.covariance)
    assert Fault.CAMERAS_STALE | Fault.ODOMETRY_STALE in later.faults
    assert later.health == Health.DEGRADED


def _changed(given: Input, change) -> Input:
    """Every frame of an input, or its reading, with something else in it."""
    if given.odometry is not None:
        return dataclasses.replace(given, odometry=change(given.odometry))
    return dataclasses.replace(given, frames=tuple(change(frame) for frame in given.frames))


def test_stamps_that_come_twice_are_refused(setup, inputs):
    pilot, _ = handled(setup, inputs)
    for given in (inputs[-1], next(g for g in reversed(inputs) if g.frames)):
        again = dataclasses.replace(given, now_ns=inputs[-1].now_ns)
        outcome = pilot.handle(again)
        assert Fault.STAMP_INVALID in outcome.faults
        assert outcome.data is None


def _frame_with(**changes):
    """Frames whose detections have something else."""

    def change(part: Odometry | FrameDetections):
        if isinstance(part, Odometry) or part.detections is None:
            return part
        arrays = {
            name: edit(getattr(part.detections, name).astype(float))
            for name, edit in changes.items()
        }
        return dataclasses.replace(part, detections=dataclasses.replace(part.detections, **arrays))

    return change


def _odometry_with(**changes):
    return lambda part: dataclasses.replace(part, **changes) if isinstance(part, Odometry) else part


ONE_NAN = np.array([[0, 0], [0, 0], [0, math.nan], [0, 0]])


@pytest.mark.parametrize(
    ("change", "fault", "reject"),
    [
        (_odometry_with(speed_mps=math.nan), Fault.ODOMETRY_INVALID, Reject(0)),
        (_odometry_with(valid=False), Fault.ODOMETRY_INVALID, Reject(0)),
        (_odometry_with(speed_mps=999.0), Fault(0), Reject.ODOMETRY),
        (_odometry_with(speed_mps=1e300), Fault.ODOMETRY_INVALID, Reject(0)),
        (_frame_with(corners_px=lambda c: c * math.nan), Fault.CORNERS_NOT_FINITE, Reject(0)),
        (_frame_with(corners_px=lambda c: c + ONE_NAN), Fault.CORNERS_NOT_FINITE, Reject(0)),
        (_frame_with(corners_px=lambda c: c * 0), Fault.FRAME_FROZEN, Reject.INNOVATION),
        (_frame_with(sigma_px=lambda s: s * math.nan), Fault.CORNERS_NOT_FINITE, Reject(0)),
        (_frame_with(sigma_px=lambda s: s * 1e-300), Fault.CORNERS_NOT_FINITE, Reject(0)),
        (_frame_with(ids=lambda i: i.astype(int) + 9), Fault.UNKNOWN_MARKER, Reject(0)),
    ],
)
def test_whatever_the_data_are_the_belief_stays_finite(setup, inputs, change, fault, reject):
    """A quarter of a second of it while driving, and what is wrong is said."""
    begin, end, inputs = 40, 65, inputs[:90]
    bad = [_changed(given, change) for given in inputs[begin:end]]
    pilot, outcomes = handled(setup, [*inputs[:begin], *bad, *inputs[end:]])
    faults, rejects = Fault(0), Reject(0)
    for outcome in outcomes[begin:end]:
        faults |= outcome.faults
        rejects |= outcome.rejects
    assert fault in faults
    assert reject in rejects
    assert Fault.NOT_FINITE not in faults
    for outcome in outcomes:
        belief = outcome.belief.bank
        for values in (belief.mean, belief.covariance, outcome.output.pose):
            assert np.isfinite(values[belief.initialised] if values.ndim > 1 else values).all()
        assert abs(outcome.steering_rad) <= pilot.limits.steering_rad
        assert abs(outcome.throttle) <= pilot.limits.throttle
    assert bool(outcomes[-1].output.located)


def test_a_loop_that_slept_begins_anew(setup, inputs):
    pilot, _ = handled(setup, inputs)
    woke_ns = inputs[-1].now_ns + 1_500 * MS
    outcome = pilot.handle(Input(woke_ns))
    assert Fault.CLOCK_JUMPED | Fault.RESTARTED in outcome.faults
    assert not outcome.output.located
    assert outcome.throttle == 0
    assert (outcome.restarts, outcome.restart_reason) == (1, "the loop was away for over a second")
    shift_ns = woke_ns + 10 * MS - inputs[0].now_ns
    located = False
    for given in inputs[:60]:
        moved = _changed(
            given, lambda part: dataclasses.replace(part, stamp_ns=part.stamp_ns + shift_ns)
        )
        outcome = pilot.handle(dataclasses.replace(moved, now_ns=given.now_ns + shift_ns))
        located |= bool(outcome.output.located)
    assert located
    assert outcome.restarts == 1


def test_a_clock_of_the_odometer_that_jumped_is_told_once(setup, inputs):
    def ahead(part):
        by_ns = 5_000 * MS if isinstance(part, Odometry) else 0
        return dataclasses.replace(part, stamp_ns=part.stamp_ns + by_ns)

    _, outcomes = handled(setup, [*inputs[:100], *(_changed(g, ahead) for g in inputs[100:])])
    faults = [outcome.faults for outcome in outcomes]
    assert sum(Fault.STAMP_INVALID in fault for fault in faults) == 9
    assert sum(Fault.CLOCK_JUMPED in fault for fault in faults) == 1
    assert outcomes[-1].health == Health.OK


def test_data_may_come_after_an_hour_of_silence(setup):
    """It does not fit into the filter's clock."""
    estimator, hour_ns = Estimator(setup.navigator()), 3600 * 10**9
    told = EventData(odometry=(0.1, 0.0))
    estimator.fuse(told, BEGIN_NS, BEGIN_NS, 0)
    fused = estimator.fuse(told, BEGIN_NS + hour_ns, BEGIN_NS + hour_ns, hour_ns)
    assert not fused.refused
    assert np.isfinite(fused.output.covariance).all()


def test_numbers_beyond_float32_are_left_out_by_the_filter():
    """They come as inf, which it does not look at, and nobody is warned again and again."""
    given = []

    def program(belief, control, events, numbers):
        given.append(events.unpack())
        return belief, belief, control, belief

    with jax.enable_x64(False):
        estimator = Estimator(make_setup().navigator(), program)
        told = EventData((0.1, 1e300), np.full((4, 1, 4, 2), -1e300), *np.ones((2, 4, 1), bool))
        told = dataclasses.replace(told, sigma_px=np.full((4, 1, 4), 1e300))
        assert not estimator.fuse(told, BEGIN_NS, BEGIN_NS, 0).refused
    corners_px = given[0].corners.corners_px
    assert corners_px.dtype == np.float32
    assert np.isneginf(corners_px[0]).all()
    assert given[0].steering_rad[0] == np.inf


numbers = st.floats() | st.floats(-2, 2) | st.floats(0, 800)
stamps = st.integers(-(2**70), 2**70) | st.integers(-900 * MS, 30 * MS)


@st.composite
def fuzzed(draw) -> Input:
    """An input that says anything."""
    now_ns = BEGIN_NS + draw(st.integers(0, 3 * 10**9))
    kind = draw(st.sampled_from(["odometry", "frames", "tick"]))
    if kind == "odometry":
        reading = Odometry(now_ns + draw(stamps), draw(numbers), draw(numbers), draw(st.booleans()))
        return Input(now_ns, reading)
    if kind == "tick":
        return Input(now_ns)
    count = draw(st.integers(0, 2))
    values = draw(st.lists(numbers, min_size=12 * count, max_size=12 * count))
    corners_px, sigma_px = np.split(np.array(values, float), [8 * count])
    found = Detections(
        np.array(draw(st.lists(st.integers(0, 1), min_size=count, max_size=count)), int),
        corners_px.reshape(-1, 4, 2),
        sigma_px.reshape(-1, 4),
        np.ones(count, bool),
        ("tag36h11",) * count,
    )
    camera = draw(st.integers(0, 3))
    return Input(now_ns, frames=(FrameDetections(camera, now_ns + draw(stamps), found),))


@settings(max_examples=15, derandomize=True)
@drawn(st.lists(fuzzed(), max_size=10))
def test_whatever_comes_in_what_comes_out_is_finite(setup, inputs, told):
    pilot, _ = handled(setup, inputs[:20])
    shift_ns = inputs[20].now_ns - BEGIN_NS
    for one in sorted(told, key=lambda one: one.now_ns):
        outcome = pilot.handle(dataclasses.replace(one, now_ns=one.now_ns + shift_ns))
        assert np.isfinite(outcome.output.pose).all()
        assert np.isfinite(outcome.output.covariance).all()
        assert Fault.NOT_FINITE not in outcome.faults
        assert abs(outcome.steering_rad) <= pilot.limits.steering_rad
        assert abs(outcome.throttle) <= pilot.limits.throttle


def test_a_sigma_of_ones_own_stands_for_the_detectors(setup, inputs):
    _, told = handled(dataclasses.replace(setup, corner_sigma_px=0.3), inputs[:20])
    _, detected = handled(setup, inputs[:20])
    assert [digest(a) == digest(b) for a, b in zip(told, detected, strict=True)] == [True] * 20
    _, rough = handled(dataclasses.replace(setup, corner_sigma_px=3.0), inputs[:20])
    spread, finer = (np.trace(outcomes[-1].output.covariance) for outcomes in (rough, detected))
    assert spread > 2 * finer


def test_a_pilot_needs_a_route():
    with pytest.raises(ValueError, match="needs a vehicle and waypoints"):
        Pilot(Navigator(worlds.qcar_rig(), worlds.paper_markers()))


def test_cameras_that_look_in_turn_are_fused_each_at_its_time(setup):
    steps = simulated(setup, 2.0, rates=Rates(camera_skew_s=0.004))
    assert {len(step.input.frames) for step in steps} == {0, 1}
    assert steps[-1].outcome.health == Health.OK
    assert np.hypot(*(steps[-1].outcome.output.pose - steps[-1].truth[:3])[:2]) < 0.02


def test_what_nothing_confirms_is_not_decided_and_its_sigma_says_so(setup):
    """No marker, the throttle in, and an odometer that stands: blocked wheels, or a dead sensor."""

    def blind(given: Input) -> list[Input]:
        blind = dataclasses.replace(given, frames=())
        return [_changed(blind, _odometry_with(speed_mps=0.0))]

    steps = simulated(setup, 4.0, change=inject.between(1.5, np.inf, blind))
    last = steps[-1]
    output = last.outcome.output
    assert bool(last.outcome.belief.decided)
    assert not output.decided
    error_m = np.hypot(*(output.pose - last.truth[:3])[:2])
    assert error_m > 0.1
    assert np.sqrt(np.trace(output.covariance[:2, :2])) > error_m / 4
    assert Fault.ODOMETRY_DOUBTFUL in last.outcome.faults
    assert (last.outcome.health, last.outcome.throttle) == (Health.STOP, 0.0)
    wrong = [step for step in steps if step.outcome.output.decided]
    assert max(np.hypot(*(s.outcome.output.pose - s.truth[:3])[:2]) for s in wrong) < 0.2


def test_a_vehicle_that_the_guard_holds_is_known_to_stand_and_to_be_well(setup):
    """Else the throttle that it does not get would be held against its wheels."""

    def hold(given: Input) -> list[Input]:
        return [dataclasses.replace(given, faults=given.faults | Fault.HELD)]

    steps = simulated(setup, 4.5, change=inject.between(1.5, 3.6, hold))
    held = [step.outcome for step in steps if Fault.HELD in step.outcome.faults]
    assert len(held) > 120
    assert {outcome.throttle for outcome in held} == {0.0}
    suspicious = Fault.NOTHING_MOVES | Fault.ODOMETRY_STUCK | Fault.ODOMETRY_DOUBTFUL
    assert not any(outcome.faults & suspicious for outcome in held)
    assert {outcome.health for outcome in held[len(held) // 2 :]} == {Health.OK}
    assert steps[-1].outcome.throttle > 0
    assert steps[-1].outcome.health is Health.OK


def test_who_leaves_the_route_stands(setup):
    """Carried away by a metre, it knows where it is again, and does not drive from there."""
    setup = dataclasses.replace(setup, route=dataclasses.replace(setup.route, leave_m=0.5))
    route = setup.route
    world = SimWorld(setup.rig, setup.markers, setup.vehicle, route.start_pose, BEGIN_NS)
    carried = [(1.2, -0.8, 0.0)]

    def happens(now_ns: int, world: SimWorld) -> None:
        if now_ns > BEGIN_NS + 2_000_000_000 and carried:
            world.carry_off(carried.pop())

    outcomes = [step.outcome for step in drive(setup.pilot(None), world, 6.0, happens=happens)]
    left = [outcome for outcome in outcomes if Fault.LEFT_ROUTE in outcome.faults]
    assert left
    assert {outcome.health for outcome in left} == {Health.STOP}
    assert left[-1].command[1] == 0.0
    assert not any(Fault.LEFT_ROUTE in o.faults for o in outcomes if o.now_ns < BEGIN_NS + 2e9)
