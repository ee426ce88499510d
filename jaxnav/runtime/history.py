"""The last events in the order of their stamps, and what was believed after them.

A ring of fixed size. What was believed is kept where it is still true: a late event undoes
what had been believed since, and the next event starts from what was believed before.
"""

from dataclasses import dataclass

import numpy as np

from jaxnav.runtime.packing import Packed

EVENTS = 64  # half a second of odometry at 50 Hz, and of frames at 30 Hz in two cameras


@dataclass(frozen=True)
class Told:
    """What an event says: odometry, corners of some cameras, or both."""

    odometry: tuple[float, float] | None = None  # speed_mps, steering_rad
    corners_px: np.ndarray | None = None  # (C, M, 4, 2), finite
    visible: np.ndarray | None = None  # (C, M)
    sigma_px: np.ndarray | None = None  # (C, M, 4), positive


@dataclass
class Entry:
    """One event; `moment` is what was believed after it, None where that is not true any more."""

    stamp_ns: int
    told: Told | None  # None: where everything began
    moment: Packed | None


class History:
    """The events of one drive."""

    def __init__(self, moment: Packed, begin_ns: int, events: int = EVENTS):
        """With nothing sensed, at some instant."""
        self._events = events
        self._entries = [Entry(begin_ns, None, moment)]

    def place(self, stamp_ns: int, told: Told) -> tuple[Entry, list[Entry]] | None:
        """Take an event in.

        Returns:
            The entry to start from, whose moment is true, and all those after it, which are to be
            fused; None where the event is too old to be placed.
        """
        entries = self._entries
        index = len(entries)
        while index > 0 and entries[index - 1].stamp_ns > stamp_ns:
            index -= 1
        base = index - 1
        while base >= 0 and entries[base].moment is None:
            base -= 1
        if base < 0 or len(entries) - base > self._events:
            return None
        entries.insert(index, Entry(stamp_ns, told, None))
        for entry in entries[index:]:
            entry.moment = None
        return entries[base], entries[base + 1 :]

    def fused(self, moment: Packed, new: Entry, then: Packed) -> None:
        """Keep what is believed, and no more events than there is room.

        Args:
            moment: what is believed after the newest event.
            new: the entry that `place` has made; the next late event may start from it.
            then: what was believed after that.
        """
        new.moment = then
        self._entries[-1].moment = moment
        del self._entries[: -self._events]

    @property
    def newest_ns(self) -> int:
        """Stamp of the newest event."""
        return self._entries[-1].stamp_ns
