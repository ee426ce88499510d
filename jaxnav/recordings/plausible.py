"""Remove numbers from recorded outcomes that are too large to draw.

A pilot that diverged, or a file that somebody edited, holds poses of 1e308. A recording keeps them,
since it tells what happened; a plot, or a difference in metres, can't show them.
"""

from dataclasses import replace
from typing import Any

import numpy as np

from jaxnav.files.ranges import RANGES, is_within
from jaxnav.recordings.records import Outcomes

_MOST = RANGES["pose"].most
_UNIT = 1e-3  # a quaternion's length may be off by this

# Poses, and a number of each.
_HYPOTHESES, _CANDIDATES = ("hypotheses", "log_weight"), ("Ts_vehicle_world", "costs")


def keep_plausible(outcomes: Outcomes) -> tuple[Outcomes, int]:
    """The outcomes with NaN for implausible numbers, and the number of outcomes that had one.

    An outcome without a plausible pose is not located; such hypotheses and candidates are left out.
    """
    count = len(outcomes.now_ns)
    posed = np.asarray(is_within("pose", outcomes.pose).all(axis=1))
    spread = (np.abs(outcomes.covariance).reshape(count, -1) <= _MOST**2).all(axis=1)
    commanded = np.stack([outcomes.steering_rad, outcomes.throttle], axis=1)
    odd = (outcomes.located & ~(posed & spread)) | ~(np.abs(commanded) <= _MOST).all(axis=1)
    odd = np.asarray(odd | (np.abs(outcomes.twist) > _MOST).any(axis=1))
    shown: dict[str, Any] = {
        name: np.where(np.abs(getattr(outcomes, name)) <= _MOST, getattr(outcomes, name), np.nan)
        for name in ("steering_rad", "throttle", "twist", "nis")
    }
    shown["pose"] = np.where(posed[:, None], outcomes.pose, np.nan)
    shown["located"] = outcomes.located & posed
    shown["covariance"] = np.where(spread[:, None, None], outcomes.covariance, np.nan)
    lists: dict[str, list[np.ndarray]] = {name: [] for name in (*_HYPOTHESES, *_CANDIDATES)}
    selected = np.full(count, -1)
    for index in range(count):
        for names, are_there in ((_HYPOTHESES, _are_planar), (_CANDIDATES, _are_poses)):
            rows = [getattr(outcomes, name)[index] for name in names]
            least = min(map(len, rows))
            kept = are_there(rows[0][:least])
            odd[index] |= not kept.all()
            for name, values in zip(names, rows, strict=True):
                lists[name].append(values[:least][kept])
        chosen = outcomes.selected[index]  # of the candidates, the last of the two
        if 0 <= chosen < least and kept[chosen]:
            selected[index] = kept[:chosen].sum()
    shown |= {name: tuple(rows) for name, rows in lists.items()}
    return replace(outcomes, **shown, selected=selected), int(odd.sum())


def left_out_note(count: int) -> str:
    """The message to a person about outcomes with implausible numbers."""
    return f"left out: what {count} outcomes report that is not finite, or out of this world"


def _are_planar(poses: np.ndarray) -> np.ndarray:
    return np.asarray(is_within("pose", poses).all(axis=1))


def _are_poses(Ts: np.ndarray) -> np.ndarray:
    with np.errstate(over="ignore"):
        length = np.linalg.norm(Ts[:, :4], axis=1)
    near: np.ndarray = (np.abs(length - 1) < _UNIT) & is_within("pose", Ts[:, 4:]).all(axis=1)
    return near
