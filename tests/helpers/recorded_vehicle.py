"""The simulated car, with every word that it is told in a file: for tests of other processes."""

import os
import time
from dataclasses import dataclass
from pathlib import Path

from jaxnav.drive.interfaces import Setup
from jaxnav.drive.limits import limits_of
from jaxnav.vehicles import sim
from jaxnav.vehicles.world import SimWorld

NAME = f"{__name__}:open_vehicle"


class RecordedVehicle(sim.SimVehicle):
    """Each line of the file: when, by `time.monotonic_ns()` and by its own clock, which waits for a
    busy machine, what it was told, and its true pose."""

    def __init__(self, world: SimWorld, path: str):
        super().__init__(world)
        self._file = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_APPEND, 0o600)

    def write(self, *command: float) -> None:
        super().write(*command)
        self._tell(command)

    def stop(self) -> None:
        super().stop()
        self._tell(limits_of(self.world.vehicle).zero)

    def _tell(self, command: tuple[float, ...]) -> None:
        clock_ns = self.waiting_clock.now_ns()
        numbers = [*command, *map(float, self.world.state(clock_ns)[:3])]
        # One call, so that lines of several threads do not mix and outlive the process.
        told = " ".join(f"{number:.7g}" for number in numbers)
        line = f"{time.monotonic_ns()} {clock_ns} {told}\n"
        os.write(self._file, line.encode())


def open_vehicle(setup: Setup) -> RecordedVehicle:
    """Options: log, the file; and those of sim."""
    return RecordedVehicle(sim.open_vehicle(setup).world, setup.options["log"])


setattr(open_vehicle, "shares_process", True)  # noqa: B010  (the cameras of sim look at its world)


@dataclass(frozen=True)
class Word:
    """What the vehicle was told.

    Attributes:
        clock_ns: the time by the vehicle's own clock.
        throttle: of a car; of another base the largest part of its twist.
        pose: where it truly was, x_m, y_m, psi_rad.
    """

    stamp_ns: int
    clock_ns: int
    throttle: float
    pose: tuple[float, ...] = ()


def words(path: Path) -> list[Word]:
    """All of it so far; none where no vehicle was opened."""
    if not path.exists():
        return []
    whole_lines = path.read_text().rpartition("\n")[0].splitlines()
    return [_word(*line.split()) for line in whole_lines]


def _word(stamp: str, clock: str, *numbers: str) -> Word:
    *command, x_m, y_m, psi_rad = map(float, numbers)
    throttle = command[1] if len(command) == 2 else max(map(abs, command))
    return Word(int(stamp), int(clock), throttle, (x_m, y_m, psi_rad))
