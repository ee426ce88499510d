"""What a set of drives amounts to: rates and medians, each with its 95 % interval.

Frames of one drive are not independent, so every interval counts drives: Wilson's for success, and
for everything else the bootstrap over drives.
"""

from collections.abc import Callable, Sequence
from typing import Any

import jax
import numpy as np

from jaxnav.simulation.rollout import Trace
from jaxnav.simulation.scenarios import Scenario

WRONG_DEG = 20.0  # a heading this far off is that of the mirror image, or worse
_RESAMPLES = 1000
_Z = 1.959963984540054


class Drives:
    """Finished drives of one navigator in one scenario."""

    def __init__(self, traces: Sequence[Trace], scenario: Scenario):
        """Traces of any number of seeds, (S, frames) each, frames of every seed in order."""
        trace: Any = jax.tree.map(lambda *leaves: np.concatenate(leaves, axis=1), *traces)
        self._counted = trace.active & trace.located
        self._decided = self._counted & trace.decided
        times_s = np.arange(trace.active.shape[1]) * scenario.frame_period_s
        self._late = self._counted & (times_s >= 2.0)
        yaw_rad = (trace.pose[..., 2] - trace.true_pose[..., 2] + np.pi) % (2 * np.pi) - np.pi
        self._wrong = np.abs(yaw_rad) > np.deg2rad(WRONG_DEG)
        self._position_m = np.linalg.norm((trace.pose - trace.true_pose)[..., :2], axis=-1)
        self._nees = trace.nees
        self.duration_s = trace.active.sum(axis=1) * scenario.frame_period_s
        self.time_to_decide_s = np.where(
            self._decided.any(axis=1), times_s[self._decided.argmax(axis=1)], np.inf
        )
        passed = trace.passed.max(axis=1) >= len(scenario.waypoints_m)
        stayed = trace.on_floor.all(axis=1)
        last = trace.active.sum(axis=1) - 1
        right_at_last = ~self._wrong[np.arange(len(last)), last]
        self.success = stayed & (passed if scenario.drives else right_at_last)

    @staticmethod
    def joined(parts: Sequence["Drives"]) -> "Drives":
        """The drives of several batches as one set."""
        whole: Drives = object.__new__(Drives)
        frames = max(part._counted.shape[1] for part in parts)
        for name in vars(parts[0]):
            arrays = [getattr(part, name) for part in parts]
            if arrays[0].ndim == 2:
                arrays = [np.pad(a, ((0, 0), (0, frames - a.shape[1]))) for a in arrays]
            setattr(whole, name, np.concatenate(arrays))
        return whole

    def first(self, count: int) -> "Drives":
        """The first drives alone."""
        some: Drives = object.__new__(Drives)
        for name, array in vars(self).items():
            setattr(some, name, array[:count])
        return some

    def summary(self) -> dict[str, Any]:
        """All measures. Fractions are of frames; errors and NEES of frames that are decided."""
        return {
            "drives": len(self.success),
            "success_rate": _wilson(int(self.success.sum()), len(self.success)),
            "wrong_branch_fraction": self._fraction(self._counted),
            "wrong_branch_fraction_after_2s": self._fraction(self._late),
            "wrong_once_decided_fraction": self._fraction(self._decided),
            "time_to_decide_s": {
                "median": _bootstrap(self.time_to_decide_s, _median),
                "p95": _bootstrap(self.time_to_decide_s, lambda x: _quantile(x, 0.95)),
            },
            "median_position_error_m": self._pooled(self._position_m, _median),
            "anees": self._pooled(self._nees, lambda x: float(np.mean(x)) if len(x) else np.nan),
            "duration_s": {"median": _bootstrap(self.duration_s, _median)},
        }

    def _fraction(self, frames: np.ndarray) -> dict[str, Any]:
        wrong, counted = (self._wrong & frames).sum(axis=1), frames.sum(axis=1)
        total = max(int(counted.sum()), 1)
        rng = np.random.default_rng(0)
        picks = rng.integers(0, len(wrong), (_RESAMPLES, len(wrong)))
        resampled = wrong[picks].sum(axis=1) / np.maximum(counted[picks].sum(axis=1), 1)
        low, high = np.percentile(resampled, [2.5, 97.5])
        if not wrong.any():
            # No drive was ever wrong: what a drive's rate of being wrong may still be.
            high = 1 - 0.05 ** (1 / len(wrong))
        return {"value": float(wrong.sum() / total), "interval": [float(low), float(high)]}

    def _pooled(
        self, values: np.ndarray, statistic: Callable[[np.ndarray], float]
    ) -> dict[str, Any]:
        drives = [v[frames] for v, frames in zip(values, self._decided, strict=True)]
        rng = np.random.default_rng(0)
        resampled = [
            statistic(
                np.concatenate([drives[i] for i in rng.integers(0, len(drives), len(drives))])
            )
            for _ in range(100)
        ]
        low, high = np.nanpercentile(resampled, [2.5, 97.5])
        value = statistic(np.concatenate(drives))
        return {"value": float(value), "interval": [float(low), float(high)]}


def _wilson(hits: int, count: int) -> dict[str, Any]:
    """Source: Wilson (1927)."""
    rate = hits / count
    center = (rate + _Z**2 / (2 * count)) / (1 + _Z**2 / count)
    half = _Z / (1 + _Z**2 / count) * np.sqrt(rate * (1 - rate) / count + (_Z / (2 * count)) ** 2)
    return {
        "value": rate,
        "interval": [float(max(center - half, 0)), float(min(center + half, 1))],
    }


def _bootstrap(values: np.ndarray, statistic: Callable[[np.ndarray], float]) -> dict[str, Any]:
    rng = np.random.default_rng(0)
    picks = rng.integers(0, len(values), (_RESAMPLES, len(values)))
    ordered = np.sort([statistic(values[pick]) for pick in picks])
    low, high = ordered[int(0.025 * _RESAMPLES)], ordered[int(0.975 * _RESAMPLES) - 1]
    return {"value": float(statistic(values)), "interval": [float(low), float(high)]}


def _median(values: np.ndarray) -> float:
    return _quantile(values, 0.5)


def _quantile(values: np.ndarray, share: float) -> float:
    """An order statistic: infinite values stay what they are."""
    if not len(values):
        return float("nan")
    return float(np.partition(values, k := min(int(share * len(values)), len(values) - 1))[k])
