"""Drives of the simulated car through the pilot that all tests share, and recordings of them."""

from collections.abc import Iterable
from pathlib import Path
from typing import Any

from jaxnav.drive.pilot import Input, Outcome
from jaxnav.files import Route
from jaxnav.recordings.drive_setup import DriveSetup
from jaxnav.recordings.recorder import Recorder
from jaxnav.vehicles.conformance.faults import WAYPOINTS_M
from jaxnav.vehicles.conformance.lockstep import BEGIN_NS, Step, drive
from jaxnav.vehicles.world import SimWorld
from tests import worlds

ROUTE = Route(WAYPOINTS_M, 0.15, worlds.START_VIEW)


def make_setup() -> DriveSetup:
    """The paper's car on a long route. One compiled program does for whatever is changed in it."""
    return DriveSetup(worlds.qcar_rig(), worlds.paper_markers(), worlds.qcar(), ROUTE, float64=True)


def simulated(
    setup: DriveSetup, duration_s: float, folder: Path | None = None, **how
) -> list[Step]:
    """A drive in lockstep; see there.

    Args:
        folder: of executables, see `DriveSetup.pilot`.
    """
    start = setup.route_on_map.start_pose
    world = SimWorld(setup.rig, setup.markers, setup.vehicle, start, BEGIN_NS)
    return list(drive(setup.pilot(folder), world, duration_s, **how))


def record(path: Path, header: dict[str, Any], told: Iterable[tuple[Input, Outcome]]) -> None:
    """What the loop records of a drive."""
    recorder = Recorder(path, header, queue_messages=100_000)
    for given, outcome in told:
        recorder.record(given, outcome)
    recorder.close(timeout_s=60)
    assert (recorder.dropped, recorder.failed) == (0, None)
