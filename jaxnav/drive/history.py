"""Keep the last events in the order of their stamps, with the beliefs after them.

A late event invalidates the beliefs of all later events, and fusion starts again from the last
belief before it. Every event that `Stamps` lets in has a place, whatever the rates: events are
kept for `OLD_NS`. Readings of an odometer that come faster than `THIN_NS` are fused as they come,
but only a part of them is kept to be fused again.
"""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float

from jaxnav.drive.packing import Packed
from jaxnav.drive.stamps import OLD_NS

# At 100 Hz every reading is kept, at higher rates about that many: at 1 m/s a car moves 8 mm
# in this time, and braking at 3 m/s^2 changes its speed by 2 %.
THIN_NS = 8_000_000
# Bounded for any input: 800 ms of the odometer and of cameras that look 400 times a second.
KEPT = 420


@dataclass(frozen=True)
class EventData:
    """The data of an event: odometry, corners of some cameras, or both."""

    odometry: tuple[float, ...] | None = None  # the values of a reading, see `interfaces`
    corners_px: Float[np.ndarray, "C M 4 2"] | None = None  # finite
    visible: Bool[np.ndarray, "C M"] | None = None
    sigma_px: Float[np.ndarray, "C M 4"] | None = None  # positive


@dataclass(frozen=True, kw_only=True)
class Sighting(EventData):
    """The corners of one frame or more that were captured together."""

    corners_px: Float[np.ndarray, "C M 4 2"]
    visible: Bool[np.ndarray, "C M"]
    sigma_px: Float[np.ndarray, "C M 4"]

    def hiding(self, hidden: Bool[np.ndarray, "#C #M"]) -> "Sighting | None":
        """The sighting without these views of markers; None where that leaves no marker."""
        if not (self.visible & hidden).any():
            return self
        visible = self.visible & ~hidden
        return replace(self, visible=visible) if visible.any() else None


@dataclass
class HistoryEntry:
    """One event and the belief after it, None where a late event has invalidated it."""

    stamp_ns: int
    data: EventData | None  # None: the beginning
    belief: Packed | None


class History:
    """The recent events of one drive."""

    def __init__(self, belief: Packed, begin_ns: int):
        """Begin with a belief at some instant, before any event."""
        self._entries = [HistoryEntry(begin_ns, None, belief)]

    def place(
        self, stamp_ns: int, data: EventData
    ) -> tuple[HistoryEntry, list[HistoryEntry]] | None:
        """Insert an event.

        Returns:
            The entry to start from, whose belief is valid, and all entries after it, which must be
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
        entries.insert(index, HistoryEntry(stamp_ns, data, None))
        for entry in entries[index:]:
            entry.belief = None
        return entries[base], entries[base + 1 :]

    def store(self, belief: Packed, new: HistoryEntry, then: Packed) -> None:
        """Keep the new beliefs, and drop events that are no longer needed.

        Args:
            belief: after the newest event.
            new: the entry that `place` has made; the next late event may start from it.
            then: the belief after the new entry.
        """
        entries = self._entries
        new.belief = then
        entries[-1].belief = belief
        # The reading before the newest goes if it follows its predecessor too soon.
        last = entries[-3:]
        if len(last) == 3 and all(entry.data and entry.data.corners_px is None for entry in last):
            if last[1].stamp_ns - last[0].stamp_ns < THIN_NS:
                del entries[-2]
        # So does all before the belief from which the oldest allowed event can start.
        oldest_ns = entries[-1].stamp_ns - OLD_NS
        base = 0
        for index, entry in enumerate(entries):
            if entry.stamp_ns > oldest_ns:
                break
            if entry.belief is not None:
                base = index
        del entries[: max(base, len(entries) - KEPT)]
