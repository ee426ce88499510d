"""The vehicle's health: worse at once, better after a while, and never in motion when blind."""

import dataclasses
import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from jaxnav.drive.flags import Fault, Health
from jaxnav.drive.health import LOOKS, MOST_RESTARTS, SPEED_FACTOR, Monitor, Senses

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


INF, F = math.inf, Fault
LOST = {"located": False}
BLIND = {"fix_age_s": 1.01}
EXPLORES = {"decided": False}
UNCONFIRMED = {"confirmed": False}


@pytest.mark.parametrize(
    ("changes", "health", "faults"),
    [
        ({}, Health.OK, F(0)),
        (LOST, Health.INIT, F(0)),
        (EXPLORES, Health.ALIGNED, F(0)),
        (UNCONFIRMED, Health.INIT, F(0)),
        (UNCONFIRMED | EXPLORES, Health.ALIGNED, F(0)),
        ({"refused": True}, Health.STOP, F(0)),
        ({"refused": True} | UNCONFIRMED, Health.STOP, F(0)),
        ({"cameras_age_s": ()}, Health.OK, F(0)),
        ({"cameras_age_s": (0.03, 0.21)}, Health.OK, F.CAMERA_STALE),
        ({"cameras_age_s": (INF, 0.21)}, Health.DEGRADED, F.CAMERA_STALE | F.CAMERAS_STALE),
        ({"fix_age_s": 1.01}, Health.DEAD_RECKONING, F.NO_MARKER),
        ({"fix_age_s": 2.01}, Health.DEGRADED, F.NO_MARKER),
        ({"fix_age_s": 5.01}, Health.STOP, F.NO_MARKER),
        ({"odometry_age_s": 0.11}, Health.DEGRADED, F.ODOMETRY_STALE),
        (BLIND | {"odometry_age_s": 1.01}, Health.STOP, F.ODOMETRY_STALE | F.NO_MARKER),
        ({"position_sigma_m": 0.51}, Health.STOP, F.UNSURE),
        ({"position_sigma_m": math.nan}, Health.STOP, F.UNSURE),
        ({"position_sigma_m": 0.51} | EXPLORES, Health.ALIGNED, F(0)),
        ({"distance_m": 3.01}, Health.STOP, F.FAR_FROM_FIX),
        ({"restarts": MOST_RESTARTS}, Health.OK, F(0)),
        ({"restarts": MOST_RESTARTS + 1}, Health.STOP, F.RESTARTED_OFTEN),
        ({"restarts": MOST_RESTARTS + 1} | LOST, Health.STOP, F.RESTARTED_OFTEN),
        ({"faults": F.NOT_FINITE}, Health.STOP, F.NOT_FINITE),
        ({"faults": F.NOT_FINITE} | LOST, Health.STOP, F.NOT_FINITE),
        ({"faults": F.VEHICLE_FAILED}, Health.STOP, F.VEHICLE_FAILED),
        ({"faults": F.ODOMETRY_STUCK}, Health.DEGRADED, F.ODOMETRY_STUCK),
        ({"faults": F.RECORDER_FAILED}, Health.OK, F.RECORDER_FAILED),
        ({"faults": F.NOTHING_MOVES}, Health.STOP, F.NOTHING_MOVES),
        ({"faults": F.RELOCATED}, Health.DEGRADED, F.RELOCATED),
        ({"faults": F.WAYS_DISPUTED}, Health.DEGRADED, F.WAYS_DISPUTED),
        ({"faults": F.MARKER_OUTVOTED}, Health.OK, F.MARKER_OUTVOTED),
        ({"faults": F.ODOMETRY_DOUBTFUL}, Health.DEGRADED, F.ODOMETRY_DOUBTFUL),
        (BLIND | {"faults": F.ODOMETRY_DOUBTFUL}, Health.STOP, F.ODOMETRY_DOUBTFUL | F.NO_MARKER),
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
