"""Say when the vehicle has left its route: the way from where it began, past all waypoints."""

import math
from collections.abc import Sequence
from itertools import pairwise

import numpy as np
from jaxtyping import Float


class Corridor:
    """All that is within a distance of a drive's route."""

    def __init__(self, waypoints_m: Sequence[Sequence[float]] | np.ndarray, leave_m: float):
        self._waypoints_m: list[list[float]] = np.asarray(waypoints_m, float).tolist()
        self._leave_m = leave_m
        self._legs_m: list[tuple[list[float], list[float]]] = []

    def is_left(self, place_m: Float[np.ndarray, " 2"]) -> bool:
        """Whether a place is outside; the first one asked about is where the route begins."""
        place: list[float] = place_m.tolist()  # of few legs NumPy takes ten times as long
        if not self._legs_m:
            self._legs_m = list(pairwise([place, *self._waypoints_m]))
        return all(_off_m(place, *leg_m) > self._leave_m for leg_m in self._legs_m)


def _off_m(place_m: Sequence[float], begin_m: Sequence[float], end_m: Sequence[float]) -> float:
    """From a place to the nearest point of a leg."""
    x_m, y_m = end_m[0] - begin_m[0], end_m[1] - begin_m[1]
    to_x_m, to_y_m = place_m[0] - begin_m[0], place_m[1] - begin_m[1]
    share = (to_x_m * x_m + to_y_m * y_m) / max(x_m * x_m + y_m * y_m, 1e-12)
    share = min(max(share, 0.0), 1.0)
    return math.hypot(to_x_m - share * x_m, to_y_m - share * y_m)
