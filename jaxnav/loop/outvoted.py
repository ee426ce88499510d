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

    def count(self, data: EventData, outvoted: Bool[np.ndarray, " M"]) -> None:
        """Count the votes of a frame.

        Args:
            outvoted: (M,), which markers the filter found to be outvoted.
        """
        assert data.visible is not None
        in_view = data.visible.any(axis=0)
        if in_view.sum() >= LEAST_MARKERS:
            times = self._times + np.where(outvoted, 1, -1) * in_view
            self._times = np.clip(times, 0, 2 * _OFTEN)

    @property
    def outvoted(self) -> tuple[int, ...]:
        """The ids of the markers that have more votes against them than for them."""
        return tuple(self._ids[index] for index in np.flatnonzero(self._times))

    def remove_outvoted(self, data: EventData) -> EventData | None:
        """The data without markers that were often outvoted, if too few are in view to vote.

        None where that leaves nothing.
        """
        assert data.visible is not None
        in_view = data.visible.any(axis=0)
        hidden = in_view & (self._times >= _OFTEN)
        if in_view.sum() >= LEAST_MARKERS or not hidden.any():
            return data
        return data.hiding(np.broadcast_to(hidden, data.visible.shape))
