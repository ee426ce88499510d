"""Remember markers that the others have outvoted, and hide them when too few are in view."""

import numpy as np
from jaxtyping import Bool

from jaxnav.loop.history import EventData
from jaxnav.pose.consistency import LEAST_MARKERS

_OFTEN = 10  # frames with a contradiction by the others minus frames without one


class MarkerVotes:
    """The votes against each marker in one drive. Only frames with enough markers to vote count."""

    def __init__(self, ids: tuple[int, ...]):
        """Args:
        ids: ids of the map's markers, in its order.
        """
        self._ids = ids
        self._times = np.zeros(len(ids), int)

    def count(self, data: EventData, outvoted: Bool[np.ndarray, " M"]) -> tuple[int, ...]:
        """Count the votes of a frame; return the ids of the markers outvoted in it.

        Args:
            outvoted: (M,), which markers the filter found to be outvoted.
        """
        if len(self._ids) < LEAST_MARKERS or data.visible is None:
            return ()
        in_view = data.visible.any(axis=0)
        if in_view.sum() < LEAST_MARKERS:
            return ()
        times = self._times + np.where(outvoted, 1, -1) * in_view
        self._times = np.clip(times, 0, 2 * _OFTEN)
        return self._named(outvoted)

    def remove_outvoted(self, data: EventData) -> tuple[EventData | None, tuple[int, ...]]:
        """The data without markers that were often outvoted, if too few can vote, and their ids."""
        if len(self._ids) < LEAST_MARKERS or data.visible is None:
            return data, ()
        in_view = data.visible.any(axis=0)
        hidden = in_view & (self._times >= _OFTEN)
        if in_view.sum() >= LEAST_MARKERS or not hidden.any():
            return data, ()
        left = data.hiding(np.broadcast_to(hidden, data.visible.shape))
        return left, self._named(hidden)

    def _named(self, which: np.ndarray) -> tuple[int, ...]:
        return tuple(self._ids[index] for index in np.flatnonzero(which))
