"""The last events in the order of their stamps, and what was believed after them.

What was believed is kept where it is still true: a late event undoes what had been believed since,
and the next event starts from what was believed before. All that `Stamps` lets in has its place,
whatever the rates: events are kept for `OLD_NS`. Readings of an odometer that come faster than
`THIN_NS` are fused as they come, but of those only so many are kept to be fused once more.
"""

from dataclasses import dataclass

import numpy as np

from jaxnav.compiling.packing import Packed
from jaxnav.loop.stamps import OLD_NS

# At 100 Hz every reading is kept, at higher rates about that many: at 1 m/s a car moves 8 mm
# meanwhile, and where it brakes with 3 m/s^2 its speed changes by 2 %.
THIN_NS = 8_000_000
# Bounded, whatever is told: 800 ms of the odometer and of cameras that look 400 times a second.
KEPT = 420


@dataclass(frozen=True)
class Told:
    """What an event says: odometry, corners of some cameras, or both."""

    odometry: tuple[float, float] | None = None  # speed_mps, steering_rad
    corners_px: np.ndarray | None = None  # (C, M, 4, 2), finite
    visible: np.ndarray | None = None  # (C, M)
    sigma_px: np.ndarray | None = None  # (C, M, 4), positive


@dataclass
class Entry:
    """One event; `belief` is what was believed after it, None where that is not true any more."""

    stamp_ns: int
    told: Told | None  # None: where everything began
    belief: Packed | None


class History:
    """The events of one drive."""

    def __init__(self, belief: Packed, begin_ns: int):
        """With nothing sensed, at some instant."""
        self._entries = [Entry(begin_ns, None, belief)]

    def place(self, stamp_ns: int, told: Told) -> tuple[Entry, list[Entry]] | None:
        """Take an event in.

        Returns:
            The entry to start from, whose belief is true, and all those after it, which are to be
            fused; None where the event is too old to be placed.
        """
        entries = self._entries
        index = len(entries)
        while index > 0 and entries[index - 1].stamp_ns > stamp_ns:
            index -= 1
        base = index - 1
        while base >= 0 and entries[base].belief is None:
            base -= 1
        if base < 0:
            return None
        entries.insert(index, Entry(stamp_ns, told, None))
        for entry in entries[index:]:
            entry.belief = None
        return entries[base], entries[base + 1 :]

    def fused(self, belief: Packed, new: Entry, then: Packed) -> None:
        """Keep what is believed, and no more events than may be needed.

        Args:
            belief: what is believed after the newest event.
            new: the entry that `place` has made; the next late event may start from it.
            then: what was believed after that.
        """
        new.belief = then
        self._entries[-1].belief = belief
        self._thin()
        self._forget()

    def _thin(self) -> None:
        """Leave out the reading before the newest where it follows another one too soon."""
        last = self._entries[-3:]
        if len(last) == 3 and all(entry.told and entry.told.corners_px is None for entry in last):
            before, middle, _ = last
            if middle.stamp_ns - before.stamp_ns < THIN_NS:
                del self._entries[-2]

    def _forget(self) -> None:
        """All before the last belief that an event as old as may be can start from."""
        entries = self._entries
        oldest_ns = entries[-1].stamp_ns - OLD_NS
        base = 0
        for index, entry in enumerate(entries):
            if entry.stamp_ns > oldest_ns:
                break
            if entry.belief is not None:
                base = index
        del entries[: max(base, len(entries) - KEPT)]

    @property
    def newest_ns(self) -> int:
        """Stamp of the newest event."""
        return self._entries[-1].stamp_ns
