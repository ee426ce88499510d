"""Say when the vehicle has left its route: the way from where it began, past all waypoints."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float


class Corridor:
    """All that is within a distance of a drive's route."""

    def __init__(self, waypoints_m: Sequence[Sequence[float]] | np.ndarray, leave_m: float):
        self._waypoints_m, self._leave_m = np.asarray(waypoints_m, float), leave_m
        self._legs_m: tuple[np.ndarray, np.ndarray] | None = None  # begins, and ways to their ends

    def is_left(self, place_m: Float[np.ndarray, " 2"]) -> bool:
        """Whether a place is outside; the first one asked about is where the route begins."""
        if self._legs_m is None:
            corners_m = np.vstack([place_m, self._waypoints_m])
            self._legs_m = corners_m[:-1], np.diff(corners_m, axis=0)
        begins_m, ways_m = self._legs_m
        to_m = place_m - begins_m
        squared_m2 = np.maximum(np.sum(ways_m**2, axis=1), 1e-12)
        share = np.clip(np.sum(to_m * ways_m, axis=1) / squared_m2, 0, 1)
        off_m = to_m - share[:, None] * ways_m
        return bool(np.min(np.sum(off_m**2, axis=1)) > self._leave_m**2)
