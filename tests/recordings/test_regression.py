"""Recorded drives of the simulated car give the same outcomes as when they were recorded.

`pytest tests/recordings/test_regression.py --update-refs` replays the recorded inputs, makes the
outcomes the new reference, and writes a summary for review beside each recording. A recording that
is missing is driven first.
"""

from pathlib import Path

import numpy as np
import pytest

from jaxnav.drive.flags import Fault, Health, Reject, names
from jaxnav.recordings.drive_log import read_drive
from jaxnav.recordings.drive_replay import first_difference, replay_drive
from jaxnav.recordings.drive_setup import DriveSetup
from jaxnav.recordings.learnt import repeated_share
from jaxnav.recordings.records import Outcomes
from jaxnav.vehicles.conformance import injections as inject
from jaxnav.vehicles.conformance.lockstep import BEGIN_NS, Rates
from tests.helpers.simulated import make_setup, record, simulated

FOLDER = Path(__file__).parents[1] / "data" / "drives"
RATES = Rates(odometry_period_s=0.04, frame_period_s=1 / 15)  # the files are to be small
MAX_BYTES = 150_000
LINE_S = 0.5


def carried_off_once():
    left = [(-0.7, -0.7, np.pi / 2)]

    def happens(now_ns, world):
        if left and now_ns >= BEGIN_NS + 1_500_000_000:
            world.carry_off(left.pop())

    return happens


DRIVES = {
    "plain": lambda: {"duration_s": 4.0},
    "tunnel": lambda: {
        "duration_s": 5.0,
        "change": inject.between(1.3, 3.7, inject.frames(inject.nothing_seen)),
    },
    "kidnapped": lambda: {"duration_s": 4.5, "happens": carried_off_once()},
}


def in_lines(outcomes: Outcomes) -> str:
    """One line for each half second: when, where, how well, and all that was wrong meanwhile."""
    lines = []
    ends = np.append(np.arange(LINE_S, outcomes.times_s[-1], LINE_S), np.inf)
    begin = 0
    for end_s in ends:
        end = int(np.searchsorted(outcomes.times_s, end_s))
        faults, rejects = (
            int(np.bitwise_or.reduce(getattr(outcomes, name)[begin:end]))
            for name in ("faults", "rejects")
        )
        wrong = " ".join([*names(Fault(faults)), *names(Reject(rejects))]) or "-"
        x_m, y_m, psi_rad = outcomes.pose[end - 1] + 0.0
        lines.append(
            f"{outcomes.times_s[end - 1]:5.2f} s  {x_m:8.4f} {y_m:8.4f} {psi_rad:8.4f}  "
            f"{Health(outcomes.health[end - 1]).name:14} {wrong.lower()}"
        )
        begin = end
    return "\n".join(lines) + "\n"


@pytest.mark.parametrize("name", DRIVES)
def test_a_recorded_drive_comes_out_as_it_did(name, request):
    path, text = FOLDER / f"{name}.mcap", FOLDER / f"{name}.txt"
    is_updated = request.config.getoption("--update-refs")
    if is_updated and not path.exists():
        setup = make_setup()
        steps = simulated(setup, rates=RATES, **DRIVES[name]())
        told = [(step.input, step.outcome) for step in steps]
        record(path, setup.header() | {"made_by": {}}, told)
    log = read_drive(path)
    outcomes = list(replay_drive(log.inputs, DriveSetup.from_header(log.header, path), None))
    if name == "kidnapped":
        # The frames that contradict a pose until the filter gives it up repeat one error.
        assert sum(outcome.rejects != 0 for outcome in outcomes) >= 10
        assert max(repeated_share(outcome.belief) for outcome in outcomes) == 0
    difference = first_difference(log, outcomes)
    if is_updated:
        if difference is not None:
            record(path, log.header, zip(log.inputs, outcomes, strict=True))
            log = read_drive(path)
            difference = first_difference(log, outcomes)
        text.write_text(in_lines(log.outcomes))
    assert difference is None
    assert len(log.outcomes.now_ns) == len(log.inputs)
    assert text.read_text() == in_lines(log.outcomes)
    assert (log.missing, log.truncated) == ({}, False)
    assert path.stat().st_size < MAX_BYTES


def test_the_recorded_drives_are_what_they_are_called():
    plain, tunnel, kidnapped = (read_drive(FOLDER / f"{name}.mcap").outcomes for name in DRIVES)
    assert plain.health[-1] == tunnel.health[-1] == Health.OK
    assert kidnapped.health[-1] == Health.DEGRADED  # for a metre
    assert Fault.RELOCATED in Fault(int(kidnapped.faults[-20]))
    assert plain.restarts[-1] == tunnel.restarts[-1] == 0
    assert kidnapped.restarts[-1] == 1
    assert {Health.DEAD_RECKONING, Health.DEGRADED} <= set(tunnel.health.tolist())
    jump_m = np.hypot(*np.diff(kidnapped.pose[:, :2], axis=0).T).max()
    assert jump_m > 0.5
    assert max(np.hypot(*np.diff(tunnel.pose[30:, :2], axis=0).T)) < 0.1
