"""The simulated car, with every word that it is told in a file: for tests of other processes."""

import os
import time
from dataclasses import dataclass
from pathlib import Path

from jaxnav.loop.interfaces import Setup
from jaxnav.vehicles import sim
from jaxnav.vehicles.world import SimWorld

NAME = f"{__name__}:open_vehicle"


class RecordedVehicle(sim.SimVehicle):
    """Each line of the file: when, `time.monotonic_ns()`, and the throttle."""

    def __init__(self, world: SimWorld, path: str):
        super().__init__(world)
        self._file = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_APPEND, 0o600)

    def write(self, steering_rad: float, throttle: float) -> None:
        super().write(steering_rad, throttle)
        self._tell(throttle)

    def stop(self) -> None:
        super().stop()
        self._tell(0.0)

    def _tell(self, throttle: float) -> None:
        # One call, so that lines of several threads do not mix and outlive the process.
        os.write(self._file, f"{time.monotonic_ns()} {throttle!r}\n".encode())


def open_vehicle(setup: Setup) -> RecordedVehicle:
    """Options: log, the file; and those of sim."""
    return RecordedVehicle(sim.open_vehicle(setup).world, setup.options["log"])


setattr(open_vehicle, "shares_process", True)  # noqa: B010  (the cameras of sim look at its world)


@dataclass(frozen=True)
class Word:
    """What the vehicle was told."""

    stamp_ns: int
    throttle: float


def words(path: Path) -> list[Word]:
    """All of it so far; none where no vehicle was opened."""
    if not path.exists():
        return []
    whole_lines = path.read_text().rpartition("\n")[0].splitlines()
    pairs = (line.split() for line in whole_lines)
    return [Word(int(stamp), float(throttle)) for stamp, throttle in pairs]
