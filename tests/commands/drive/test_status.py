"""The status line of a drive keeps its width and its columns; notices are said once."""

import dataclasses
import math

import equinox as eqx
import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from jaxnav.commands.drive.observers import WIDTH
from jaxnav.commands.drive.status_line import notice, status_line
from jaxnav.drive.flags import Fault, Health
from tests.helpers.drives import make_outcome

FLOATS = st.floats() | st.floats(-500, 500) | st.sampled_from([-0.0, 1e308, -1e308, 5e-324])


def outcome_of(pose, flip, located, health=Health.OK, throttle=0.0371, steering_rad=-0.1):
    outcome = make_outcome(1)
    output = eqx.tree_at(
        lambda o: (o.pose, o.flip_probability, o.located),
        outcome.output,
        (np.array(pose), np.array(flip), np.array(located)),
    )
    return dataclasses.replace(
        outcome, output=output, health=health, throttle=throttle, steering_rad=steering_rad
    )


def test_a_line_reads_as_it_is_meant():
    outcome = outcome_of([1.833, -0.791, math.radians(124)], 0.0012, True, Health.DEAD_RECKONING)
    assert status_line(outcome, 30.4, 4.21, True) == (
        "  30 Hz   4.2 ms DEAD_RECKONING marker flip  0.1% x  1.83 y -0.79 m 124 deg "
        "thr  0.037 str  -5.7 deg"
    )
    lost = outcome_of([0.0, 0.0, 0.0], math.nan, False, Health.INIT, 0.0, 0.0)
    assert status_line(lost, 12345.0, math.inf, False) == (
        "#### Hz     ? ms INIT             --   flip    ?% x     - y     - m   - deg "
        "thr  0.000 str   0.0 deg"
    )


USUAL = status_line(outcome_of([1.0, 2.0, 3.0], 0.5, True), 30.0, 5.0, True)


@settings(max_examples=100)
@given(
    pose=st.tuples(FLOATS, FLOATS, FLOATS),
    flip=FLOATS,
    located=st.booleans(),
    health=st.sampled_from(Health),
    throttle=FLOATS,
    steering_rad=FLOATS,
    rate_hz=FLOATS,
    latency_ms=FLOATS,
    marker_seen=st.booleans(),
)
def test_every_line_has_the_same_width(rate_hz, latency_ms, marker_seen, **drive):
    line = status_line(outcome_of(**drive), rate_hz, latency_ms, marker_seen)
    assert len(line) == len(USUAL) <= WIDTH
    assert line.isascii()
    assert line.isprintable()
    for unit in (" Hz ", " ms ", "% x", " m", " deg thr ", " str "):
        assert line.index(unit) == USUAL.index(unit)


def test_what_begins_is_told_once():
    outcome = dataclasses.replace(
        outcome_of([1.0, 2.0, 3.0], 0.5, True),
        faults=Fault.RELOCATED | Fault.MARKER_OUTVOTED | Fault.NO_MARKER,
        restart_reason="contradicted by the corners; relocated",
        outvoted=(3, 7),
    )
    told = notice(outcome, Fault.NO_MARKER)
    assert "contradicted by the corners; relocated" in told
    assert "marker 3, 7" in told
    assert notice(outcome, outcome.faults) is None
    assert "marker" not in notice(outcome, Fault.MARKER_OUTVOTED)
    outvoted = dataclasses.replace(
        outcome, faults=Fault.CAMERA_OUTVOTED, outvoted_cameras=("right",)
    )
    assert "the camera right does not see markers" in notice(outvoted, Fault(0))
    for fault in (Fault.WAYS_DISPUTED, Fault.ODOMETRY_DOUBTFUL):
        assert notice(dataclasses.replace(outcome, faults=fault), Fault(0))
    assert notice(dataclasses.replace(outcome, faults=Fault.CAMERA_STALE), Fault(0)) is None


@given(st.tuples(*[st.floats() | st.floats(-9, 9)] * 3))
def test_the_status_line_of_a_base_has_its_twist_and_always_one_width(twist):
    outcome = dataclasses.replace(make_outcome(1), twist=(0.25, -0.5, math.radians(-90)))
    line = status_line(outcome, 30.0, 4.0, True)
    assert line.endswith("go  0.25 -0.50  -90.0")
    other = dataclasses.replace(outcome, twist=twist)
    assert len(status_line(other, 30.0, 4.0, True)) == len(line) <= WIDTH


def test_a_gyro_that_begins_to_fail_is_named_once():
    invalid = dataclasses.replace(make_outcome(1), faults=Fault.GYRO_INVALID)
    assert "the gyro's readings are not finite" in notice(invalid, Fault(0))
    assert notice(invalid, Fault.GYRO_INVALID) is None
    stale = dataclasses.replace(invalid, faults=Fault.GYRO_STALE)
    assert notice(stale, Fault(0)) == "the gyro tells nothing: the drive goes on without it"
    silent = dataclasses.replace(stale, faults=Fault.GYRO_STALE | Fault.ODOMETRY_STALE)
    assert notice(silent, Fault(0)) is None  # the whole vehicle tells nothing
