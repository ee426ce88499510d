"""The vehicle's health: worse at once, better after a while, and never in motion when blind."""

import dataclasses
import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from jaxnav.drive.flags import Fault, Health, Reject, names
from jaxnav.drive.health import (
    LOOKS,
    MOST_RESTARTS,
    SPEED_FACTOR,
    Monitor,
    Senses,
    Timeouts,
)

WELL = Senses(
    located=True,
    decided=True,
    fix_age_s=0.03,
    odometry_age_s=0.02,
    cameras_age_s=(0.03, 0.04),
    position_sigma_m=0.01,
    distance_m=0.02,
    faults=Fault(0),
)


def seen(**changes) -> tuple[Health, Fault]:
    """What a new monitor says."""
    return Monitor().look(dataclasses.replace(WELL, **changes))


@pytest.mark.parametrize(
    ("changes", "health", "faults"),
    [
        ({}, Health.OK, Fault(0)),
        ({"located": False}, Health.INIT, Fault(0)),
        ({"decided": False}, Health.ALIGNED, Fault(0)),
        ({"cameras_age_s": (0.03, 0.21)}, Health.OK, Fault.CAMERA_STALE),
        (
            {"cameras_age_s": (math.inf, 0.21)},
            Health.DEGRADED,
            Fault.CAMERA_STALE | Fault.CAMERAS_STALE,
        ),
        ({"fix_age_s": 1.01}, Health.DEAD_RECKONING, Fault.NO_MARKER),
        ({"fix_age_s": 2.01}, Health.DEGRADED, Fault.NO_MARKER),
        ({"fix_age_s": 5.01}, Health.STOP, Fault.NO_MARKER),
        ({"odometry_age_s": 0.11}, Health.DEGRADED, Fault.ODOMETRY_STALE),
        (
            {"odometry_age_s": 1.01, "fix_age_s": 1.01},
            Health.STOP,
            Fault.ODOMETRY_STALE | Fault.NO_MARKER,
        ),
        ({"position_sigma_m": 0.51}, Health.STOP, Fault.UNSURE),
        ({"position_sigma_m": math.nan}, Health.STOP, Fault.UNSURE),
        ({"position_sigma_m": 0.51, "decided": False}, Health.ALIGNED, Fault(0)),
        ({"distance_m": 3.01}, Health.STOP, Fault.FAR_FROM_FIX),
        ({"faults": Fault.NOT_FINITE}, Health.STOP, Fault.NOT_FINITE),
        ({"faults": Fault.VEHICLE_FAILED}, Health.STOP, Fault.VEHICLE_FAILED),
        ({"faults": Fault.NOT_FINITE, "located": False}, Health.STOP, Fault.NOT_FINITE),
        ({"faults": Fault.ODOMETRY_STUCK}, Health.DEGRADED, Fault.ODOMETRY_STUCK),
        ({"faults": Fault.RECORDER_FAILED}, Health.OK, Fault.RECORDER_FAILED),
        ({"faults": Fault.NOTHING_MOVES}, Health.STOP, Fault.NOTHING_MOVES),
        ({"restarts": MOST_RESTARTS}, Health.OK, Fault(0)),
        ({"restarts": MOST_RESTARTS + 1}, Health.STOP, Fault.RESTARTED_OFTEN),
        (
            {"restarts": MOST_RESTARTS + 1, "located": False},
            Health.STOP,
            Fault.RESTARTED_OFTEN,
        ),
        ({"cameras_age_s": ()}, Health.OK, Fault(0)),
        ({"confirmed": False}, Health.INIT, Fault(0)),
        ({"confirmed": False, "decided": False}, Health.ALIGNED, Fault(0)),
        ({"refused": True}, Health.STOP, Fault(0)),
        ({"refused": True, "confirmed": False}, Health.STOP, Fault(0)),
        ({"faults": Fault.RELOCATED}, Health.DEGRADED, Fault.RELOCATED),
        ({"faults": Fault.WAYS_DISPUTED}, Health.DEGRADED, Fault.WAYS_DISPUTED),
        ({"faults": Fault.MARKER_OUTVOTED}, Health.OK, Fault.MARKER_OUTVOTED),
        ({"faults": Fault.ODOMETRY_DOUBTFUL}, Health.DEGRADED, Fault.ODOMETRY_DOUBTFUL),
        (
            {"faults": Fault.ODOMETRY_DOUBTFUL, "fix_age_s": 1.01},
            Health.STOP,
            Fault.ODOMETRY_DOUBTFUL | Fault.NO_MARKER,
        ),
    ],
)
def test_what_is_missing_costs(changes, health, faults):
    assert seen(**changes) == (health, faults)


def test_worse_is_at_once_and_better_after_ten_looks():
    monitor = Monitor()
    bad = dataclasses.replace(WELL, fix_age_s=3.0)
    assert monitor.look(WELL)[0] == Health.OK
    assert monitor.look(bad)[0] == Health.DEGRADED
    for _ in range(LOOKS - 1):
        assert monitor.look(WELL)[0] == Health.DEGRADED
    assert monitor.look(bad)[0] == Health.DEGRADED  # and all over again
    looks = [monitor.look(WELL)[0] for _ in range(LOOKS)]
    assert looks == [Health.DEGRADED] * (LOOKS - 1) + [Health.OK]


def test_ten_contradictions_more_than_agreements_degrade():
    monitor = Monitor()
    for believed in [False] * 9 + [True, False]:
        monitor.corners(believed)
    assert monitor.look(WELL)[0] == Health.OK
    monitor.corners(False)
    assert monitor.look(WELL)[0] == Health.DEGRADED
    for _ in range(1000):
        monitor.corners(False)
    for _ in range(11):  # however long it lasted
        monitor.corners(True)
    assert [monitor.look(WELL)[0] for _ in range(LOOKS)][-1] == Health.OK


ages = st.floats(0, 8, allow_nan=False) | st.just(math.inf)
senses = st.builds(
    Senses,
    located=st.booleans(),
    decided=st.booleans(),
    fix_age_s=ages,
    odometry_age_s=ages,
    cameras_age_s=st.lists(ages, max_size=4).map(tuple),
    position_sigma_m=st.floats(),
    distance_m=ages,
    faults=st.sampled_from([Fault(0), *Fault]),
    confirmed=st.booleans(),
    refused=st.booleans(),
)


@given(st.lists(st.tuples(senses, st.booleans()), max_size=60))
def test_it_never_gets_better_in_a_hurry_nor_worse_with_delay(looks):
    monitor, better = Monitor(), 0
    for sensed, believed in looks:
        before = monitor.health
        monitor.corners(believed)
        alone = Monitor(_doubts=monitor._doubts).look(sensed)[0]
        health, faults = monitor.look(sensed)
        assert sensed.faults in faults
        better = better + 1 if alone < before else 0
        if before <= Health.OK or alone >= before or better >= LOOKS:
            assert health == alone
            better = 0
        else:
            assert health == before


@given(senses)
def test_whoever_is_lost_or_blind_stands_still(sensed):
    health, _ = Monitor().look(sensed)
    blind = min(sensed.odometry_age_s, sensed.fix_age_s) > 1 or sensed.fix_age_s > 5
    failed = sensed.faults & (Fault.NOT_FINITE | Fault.VEHICLE_FAILED)
    if not sensed.located or blind or sensed.refused or failed:
        assert SPEED_FACTOR[health] == 0


def test_timeouts_can_be_chosen():
    patient = Monitor(Timeouts(flag_s=10, slow_s=20, stop_s=30, blind_s=40))
    assert patient.look(dataclasses.replace(WELL, fix_age_s=9.0))[0] == Health.OK
    assert patient.look(dataclasses.replace(WELL, fix_age_s=31.0))[0] == Health.STOP


def test_flags_have_names():
    assert names(Fault.CAMERA_STALE | Fault.UNSURE) == ["CAMERA_STALE", "UNSURE"]
    assert names(Reject(0)) == []
