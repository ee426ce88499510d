"""Markers that the others have outvoted: not believed when they are alone in view."""

import dataclasses

import numpy as np

from jaxnav.loop.history import Told
from jaxnav.pose.consistency import LEAST_MARKERS

_OFTEN = 10  # frames more in which the others contradicted it than frames in which they did not


class Outvoted:
    """Of one drive, marker by marker. Only frames that show enough markers to vote count."""

    def __init__(self, ids: tuple[int, ...]):
        """Args:
        ids: of the map's markers, in its order.
        """
        self._ids = ids
        self._times = np.zeros(len(ids), int)

    def count(self, told: Told, outvoted: np.ndarray) -> tuple[int, ...]:
        """Take in what came of a frame, and say which markers were outvoted in it.

        Args:
            outvoted: (M,).
        """
        if len(self._ids) < LEAST_MARKERS or told.visible is None:
            return ()
        in_view = told.visible.any(axis=0)
        if in_view.sum() < LEAST_MARKERS:
            return ()
        times = self._times + np.where(outvoted, 1, -1) * in_view
        self._times = np.clip(times, 0, 2 * _OFTEN)
        return self._named(outvoted)

    def without(self, told: Told) -> tuple[Told | None, tuple[int, ...]]:
        """What is told without those that must not stand alone, and which these are."""
        if len(self._ids) < LEAST_MARKERS or told.visible is None:
            return told, ()
        in_view = told.visible.any(axis=0)
        hidden = in_view & (self._times >= _OFTEN)
        if in_view.sum() >= LEAST_MARKERS or not hidden.any():
            return told, ()
        visible = told.visible & ~hidden[None]
        left = dataclasses.replace(told, visible=visible) if visible.any() else None
        return left, self._named(hidden)

    def _named(self, which: np.ndarray) -> tuple[int, ...]:
        return tuple(self._ids[index] for index in np.flatnonzero(which))
