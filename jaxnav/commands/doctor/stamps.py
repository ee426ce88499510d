"""Check by a recorded drive that the cameras' stamps tell when their images were taken."""

from collections.abc import Iterator
from pathlib import Path

from jaxnav.commands.doctor.findings import Finding, note, ok, warning
from jaxnav.commands.drive.delay_watch import delays_of, describe_delay, warnings
from jaxnav.drive.camera_delays import HARMLESS_S
from jaxnav.recordings.drive_log import read_drive
from jaxnav.recordings.drive_setup import DriveSetup

_DRIVE_EIGHTS = "drive eights, or stop and start, with a marker in view of it"


def stamps(path: Path) -> Iterator[Finding]:
    """Report each camera's delay against the odometer in a drive that `jaxnav run --record` wrote.

    Raises:
        BadInput: the file is no recording, or damaged, or not of a car.
    """
    log = read_drive(path)
    setup = DriveSetup.of_header(log.header, path)
    setup.car(path)
    delays = delays_of(log, setup)
    for text in warnings(delays, setup):
        what, _, do = text.partition(": ")
        yield warning(what, do)
    for name, one in zip(setup.rig.names, delays.delays, strict=True):
        if not one.known:
            text = f"camera {name!r}: {path.name} does not tell how late it is"
            yield note(text, _DRIVE_EIGHTS)
        elif not one.late:
            allowed = f"up to {HARMLESS_S * 1e3:.0f} ms is harmless"
            yield ok(f"camera {name!r} is {describe_delay(one)}; {allowed}")
