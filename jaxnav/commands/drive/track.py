"""The track of a drive that is driven again: its poses, health and faults."""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from jaxnav.loop.flags import Fault, Health, Reject, names
from jaxnav.loop.pilot import Outcome
from jaxnav.recording.outcomes import Outcomes


class TrackRow(NamedTuple):
    """The kept part of one outcome, without its bank of hypotheses."""

    now_ns: int
    pose: np.ndarray  # (3,), x_m y_m psi_rad
    T_world_vehicle: np.ndarray  # (7,) wxyz_xyz
    located: bool
    decided: bool
    health: Health
    faults: Fault
    rejects: Reject
    restarts: int
    restart_reason: str

    @staticmethod
    def of(outcome: Outcome) -> "TrackRow":
        """The kept part of an outcome."""
        output = outcome.output
        return TrackRow(
            outcome.now_ns,
            np.asarray(outcome.pose, float),
            np.asarray(outcome.T_world_vehicle, float),
            bool(output.located),
            bool(output.decided),
            outcome.health,
            outcome.faults,
            outcome.rejects,
            outcome.restarts,
            outcome.restart_reason,
        )


@dataclass(frozen=True)
class Track:
    """A track of N rows in the order of their outcomes."""

    rows: Sequence[TrackRow]

    @property
    def now_ns(self) -> np.ndarray:
        """When each input reached the pilot, (N,) ns."""
        return np.array([row.now_ns for row in self.rows], np.int64)

    @property
    def times_s(self) -> np.ndarray:
        """Times since the first row, (N,) s."""
        return np.asarray((self.now_ns - self.rows[0].now_ns) / 1e9)

    @property
    def located(self) -> np.ndarray:
        """Whether each outcome has a pose, (N,) bool."""
        return np.array([row.located for row in self.rows])

    @property
    def Ts_world_vehicle(self) -> np.ndarray:
        """Poses of the vehicle, (N, 7) wxyz_xyz."""
        return np.stack([row.T_world_vehicle for row in self.rows])

    @property
    def positions_m(self) -> np.ndarray:
        """Positions of the vehicle, (N, 3) m, NaN where not located."""
        return np.where(self.located[:, None], self.Ts_world_vehicle[:, 4:], np.nan)

    def summary(self) -> dict[str, Any]:
        """Counts of faults and rejects, shares of health, and the last pose and restarts."""
        healths = Counter(row.health.name for row in self.rows)
        last = self.rows[-1]
        return {
            "states": len(self.rows),
            "duration_s": float(self.times_s[-1]),
            "health_shares": {h.name: healths[h.name] / len(self.rows) for h in Health},
            "located_share": float(np.mean(self.located)),
            "decided_share": float(np.mean([row.decided for row in self.rows])),
            "faults": dict(Counter(name for row in self.rows for name in names(row.faults))),
            "rejects": dict(Counter(name for row in self.rows for name in names(row.rejects))),
            "final_pose": last.pose if last.located else None,
            "restarts": last.restarts,
            "restart_reason": last.restart_reason,
        }

    def distances_to(self, recorded: Outcomes) -> tuple[np.ndarray, np.ndarray]:
        """Distances (N,) m and (N,) rad to the recorded track, NaN where either has no pose."""
        index = np.searchsorted(recorded.now_ns, self.now_ns)
        known = index < len(recorded.now_ns)
        index = np.where(known, index, 0)
        if not len(recorded.now_ns):
            return np.full(len(self.rows), np.nan), np.full(len(self.rows), np.nan)
        known &= (recorded.now_ns[index] == self.now_ns) & recorded.located[index] & self.located
        difference = np.stack([row.pose for row in self.rows]) - recorded.pose[index]
        turn = np.abs(np.angle(np.exp(1j * difference[:, 2])))
        shift_m = np.hypot(difference[:, 0], difference[:, 1])
        return np.where(known, shift_m, np.nan), np.where(known, turn, np.nan)

    def rms_differences(self, recorded: Outcomes) -> dict[str, Any]:
        """Root mean square differences from the recorded track."""
        shift_m, turn_rad = self.distances_to(recorded)
        return {
            "rms_position_difference_m": _rms(shift_m),
            "rms_heading_difference_deg": np.rad2deg(_rms(turn_rad)),
        }


def _rms(values: np.ndarray) -> float:
    values = values[np.isfinite(values)]
    return float(np.sqrt(np.mean(values**2))) if len(values) else np.nan
