"""Tell what a drive learns of its sensors and cameras, while it is driven and in the end."""

import sys
from collections.abc import Sequence

import jax

from jaxnav.core.models.vehicle import Vehicle
from jaxnav.drive.flags import Fault
from jaxnav.drive.frames import FrameDetections
from jaxnav.drive.interfaces import Frame
from jaxnav.drive.pilot import Input, Outcome
from jaxnav.drive.seeing import Search
from jaxnav.errors import visible
from jaxnav.recordings.drive_setup import DriveSetup
from jaxnav.recordings.learnt import Learnt, errors_of, repeated_share

_PERIOD_NS = 2_000_000_000
_WIDTH = 100  # characters, over what the status line leaves
_CORNERS = "corners", "repeat"  # what is found of them is written in no file
_TELLS_SHARE = 0.05  # of the corners' variance
_ADOPT = "`jaxnav calibrate adopt` writes what a recorded drive has learnt into new files"


class LearntWatch:
    """Tells once of each error that the drive has learnt; see `Onlooker`."""

    faults = Fault(0)

    def __init__(self, setup: DriveSetup, tells: bool):
        """Args:
        tells: on the terminal, as soon as it is learnt; in any case in the end.
        """
        # Of NumPy: the driving thread asks no device.
        self._rig, self._vehicle = jax.device_get((setup.rig, setup.vehicle))
        self._adopts = isinstance(setup.vehicle, Vehicle)
        self._tells, self._last_ns = tells, 0
        self._told: set[tuple[str, str]] = set()
        self._found: dict[tuple[str, str], str] = {}

    def on_outcome(self, given: Input, outcome: Outcome) -> None:
        """See `Observer`."""
        if given.now_ns - self._last_ns < _PERIOD_NS or not outcome.output.decided:
            return
        self._last_ns = given.now_ns
        learnt = Learnt.from_errors(*errors_of(outcome.belief.bank), self._rig, self._vehicle)
        self._found = {} if learnt is None else learnt.found()
        share = repeated_share(outcome.belief)
        if share is not None and share >= _TELLS_SHARE:
            self._found[_CORNERS] = (
                f"{share:.0%} of the corners' variance is the same from frame to "
                "frame: the lens model, or a marker that is not flat"
            )
        for subject, sentence in self._found.items():
            if subject not in self._told:
                self._told.add(subject)
                if self._tells:
                    sys.stderr.write(f"\r{f'learnt: {visible(sentence)}':<{_WIDTH}}\n")

    def on_frame(self, name: str, frame: Frame, sighted: FrameDetections) -> None:
        """See `Observer`."""

    def close(self) -> None:
        """See `Onlooker`."""

    @property
    def closing_note(self) -> str | None:
        """See `Onlooker`."""
        if not self._found:
            return None
        lines = [f"learnt: {visible(line)}" for line in self._found.values()]
        adopts = self._adopts and self._found.keys() - {_CORNERS}
        return "\n".join([*lines, _ADOPT] if adopts else lines)


class ExposureWatch:
    """Tells in the end how long cameras expose, by the streaks of markers; see `Onlooker`."""

    faults = Fault(0)

    def __init__(self, names: Sequence[str], searches: Sequence[Search]):
        """Args:
        names: of the cameras.
        searches: one for each.
        """
        self._names, self._searches = tuple(names), tuple(searches)

    def on_outcome(self, given: Input, outcome: Outcome) -> None:
        """See `Observer`."""

    def on_frame(self, name: str, frame: Frame, sighted: FrameDetections) -> None:
        """See `Observer`."""

    def close(self) -> None:
        """See `Onlooker`."""

    @property
    def closing_note(self) -> str | None:
        """See `Onlooker`."""
        trackers = [search.tracker for search in self._searches]
        exposures_s = [None if one is None else one.learnt_exposure_s for one in trackers]
        lines = [
            f"learnt: camera {visible(name)} exposes for {1e3 * exposure_s:.1f} ms, by the streaks "
            f"of markers: `exposure_s: {exposure_s:.2g}` in rig.yaml tells it from the start"
            for name, exposure_s in zip(self._names, exposures_s, strict=True)
            if exposure_s is not None
        ]
        return "\n".join(lines) or None
