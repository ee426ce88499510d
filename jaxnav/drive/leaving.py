"""Say when the vehicle has left its route: the way from where it began, past all waypoints."""

from collections.abc import Sequence
from itertools import pairwise

import numpy as np
from jaxtyping import Float


class Corridor:
    """All that is within a distance of a drive's route."""

    def __init__(self, waypoints_m: Sequence[Sequence[float]] | np.ndarray, leave_m: float):
        # Complex: of few legs NumPy takes ten times as long as plain numbers.
        self._waypoints_m = [complex(x, y) for x, y in np.asarray(waypoints_m, float).tolist()]
        self._leave_m, self._route_m = leave_m, list[complex]()

    def is_left(self, place_m: Float[np.ndarray, " 2"]) -> bool:
        """Whether a place is outside; the first one asked about is where the route begins."""
        here_m = complex(*place_m.tolist())
        self._route_m = self._route_m or [here_m, *self._waypoints_m]
        legs_m = pairwise(self._route_m)
        return all(_off_m(here_m - begin, end - begin) > self._leave_m for begin, end in legs_m)


def _off_m(place_m: complex, leg_m: complex) -> float:
    """How far a place is from a leg; both count from where the leg begins."""
    share = (place_m * leg_m.conjugate()).real / max(abs(leg_m) ** 2, 1e-12)
    return abs(place_m - min(max(share, 0.0), 1.0) * leg_m)
