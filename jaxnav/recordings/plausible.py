"""Remove numbers from recorded outcomes that are too large to draw.

A pilot that diverged, or a file that somebody edited, holds poses of 1e308. A recording keeps them,
since it tells what happened; a plot, or a difference in metres, can't show them.
"""

from dataclasses import replace

import numpy as np

from jaxnav.files.ranges import RANGES, is_within
from jaxnav.recordings.outcomes import Outcomes

_MOST = RANGES["pose"].most
_UNIT = 1e-3  # a quaternion's length may be off by this


def keep_plausible(outcomes: Outcomes) -> tuple[Outcomes, int]:
    """The outcomes with NaN for implausible numbers, and the number of outcomes that had one.

    An outcome without a plausible pose is not located; such hypotheses and candidates are left out.
    """
    posed = _all(is_within("pose", outcomes.pose))
    commanded = np.stack([outcomes.steering_rad, outcomes.throttle], axis=1)
    odd = (outcomes.located & ~posed) | ~(np.abs(commanded) <= _MOST).all(axis=1)
    odd |= (np.abs(outcomes.twist) > _MOST).any(axis=1)
    spread = _all(np.abs(outcomes.covariance).reshape(len(posed), -1) <= _MOST**2)
    odd |= outcomes.located & ~spread
    hypotheses, log_weight = _paired(outcomes.hypotheses, outcomes.log_weight)
    Ts_vehicle_world, costs = _paired(outcomes.Ts_vehicle_world, outcomes.costs)
    banks = [_all(is_within("pose", bank)) for bank in hypotheses]
    places = [_are_poses(Ts) for Ts in Ts_vehicle_world]
    odd |= np.array([not (a.all() and b.all()) for a, b in zip(banks, places, strict=True)], bool)
    shown = replace(
        outcomes,
        pose=np.where(posed[:, None], outcomes.pose, np.nan),
        located=outcomes.located & posed,
        covariance=np.where(spread[:, None, None], outcomes.covariance, np.nan),
        steering_rad=_tame(outcomes.steering_rad),
        throttle=_tame(outcomes.throttle),
        twist=_tame(outcomes.twist),
        nis=_tame(outcomes.nis),
        hypotheses=_kept(hypotheses, banks),
        log_weight=_kept(log_weight, banks),
        Ts_vehicle_world=_kept(Ts_vehicle_world, places),
        costs=_kept(costs, places),
        selected=np.array(
            [_moved(*pair) for pair in zip(outcomes.selected, places, strict=True)], int
        ),
    )
    return shown, int(odd.sum())


def left_out_note(count: int) -> str:
    """The message to a person about outcomes with implausible numbers."""
    return f"left out: what {count} outcomes report that is not finite, or out of this world"


def _tame(values: np.ndarray) -> np.ndarray:
    return np.where(np.abs(values) <= _MOST, values, np.nan)


def _all(rows: np.ndarray) -> np.ndarray:
    whole: np.ndarray = np.all(rows, axis=1)
    return whole


def _are_poses(Ts: np.ndarray) -> np.ndarray:
    with np.errstate(over="ignore"):
        length = np.linalg.norm(Ts[:, :4], axis=1)
    near: np.ndarray = (np.abs(length - 1) < _UNIT) & is_within("pose", Ts[:, 4:]).all(axis=1)
    return near


_Rows = tuple[np.ndarray, ...]


def _paired(rows: _Rows, others: _Rows) -> tuple[_Rows, _Rows]:
    """Both tuples of arrays, each pair cut to its common number of rows."""
    counts = [min(len(a), len(b)) for a, b in zip(rows, others, strict=True)]
    return (
        tuple(row[:count] for row, count in zip(rows, counts, strict=True)),
        tuple(row[:count] for row, count in zip(others, counts, strict=True)),
    )


def _kept(rows: _Rows, which: list[np.ndarray]) -> _Rows:
    return tuple(row[kept] for row, kept in zip(rows, which, strict=True))


def _moved(selected: int, kept: np.ndarray) -> int:
    """The index of the selected row among the kept ones, -1 if it is not kept."""
    return int(kept[:selected].sum()) if 0 <= selected < len(kept) and kept[selected] else -1
