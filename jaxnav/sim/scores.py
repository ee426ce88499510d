"""Summarise a set of drives by rates and medians, each with its 95 % interval.

Frames of one drive are not independent, so every interval counts drives: Wilson's for success, the
bootstrap over drives for everything else.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import jax
import numpy as np
from jaxtyping import Bool, Float

from jaxnav.core.models.geometry import wrap_angle_np
from jaxnav.sim.rollout import Trace
from jaxnav.sim.scenarios import Scenario
from jaxnav.sim.statistics import wilson_interval

WRONG_DEG = 20.0  # a larger heading error means the mirrored pose, or worse
_RESAMPLES = 1000
_POOLED_RESAMPLES = 100  # of all frames of all drives


@dataclass(frozen=True)
class Drives:
    """The scores of finished drives of one navigator in one scenario: (S,) or (S, frames)."""

    counted: Bool[np.ndarray, "S frames"]  # frames that have a pose
    decided: Bool[np.ndarray, "S frames"]  # counted frames whose branch is decided
    late: Bool[np.ndarray, "S frames"]  # counted frames after the first two seconds
    wrong: Bool[np.ndarray, "S frames"]
    yaw_error_rad: Float[np.ndarray, "S frames"]  # not negative
    position_error_m: Float[np.ndarray, "S frames"]
    nees: Float[np.ndarray, "S frames"]
    duration_s: Float[np.ndarray, " S"]
    time_to_decide_s: Float[np.ndarray, " S"]
    success: Bool[np.ndarray, " S"]
    times_s: Float[np.ndarray, " frames"]
    scored_after_s: tuple[float, ...]

    @staticmethod
    def from_trace(drives: Trace, scenario: Scenario) -> "Drives":
        """The scores of traces with leading axes (S, frames)."""
        trace: Any = jax.device_get(drives)
        counted = trace.active & trace.located
        decided = counted & trace.decided
        times_s = np.arange(trace.active.shape[1]) * scenario.frame_period_s
        yaw_error_rad = np.abs(wrap_angle_np(trace.pose[..., 2] - trace.true_pose[..., 2]))
        wrong = yaw_error_rad > np.deg2rad(WRONG_DEG)
        passed = trace.passed.max(axis=1) >= len(scenario.waypoints_m)
        last = trace.active.sum(axis=1) - 1
        right_at_last = ~wrong[np.arange(len(last)), last]
        return Drives(
            counted=counted,
            decided=decided,
            late=counted & (times_s >= 2.0),
            wrong=wrong,
            yaw_error_rad=yaw_error_rad,
            position_error_m=np.linalg.norm((trace.pose - trace.true_pose)[..., :2], axis=-1),
            nees=trace.nees,
            duration_s=trace.active.sum(axis=1) * scenario.frame_period_s,
            time_to_decide_s=np.where(decided.any(axis=1), times_s[decided.argmax(axis=1)], np.inf),
            success=trace.on_floor.all(axis=1) & (passed if scenario.drives else right_at_last),
            times_s=times_s,
            scored_after_s=scenario.scored_after_s,
        )

    def summary(self) -> dict[str, Any]:
        """All measures. Fractions count frames; errors and NEES are over the decided frames."""
        count, rate = len(self.success), float(np.mean(self.success))
        return {
            "drives": count,
            "success_rate": _measure(rate, wilson_interval(np.array(rate), np.array(count))),
            "wrong_branch_fraction": self._fraction(self.counted),
            "wrong_branch_fraction_after_2s": self._fraction(self.late),
            "wrong_once_decided_fraction": self._fraction(self.decided),
            "time_to_decide_s": {
                "median": _bootstrap(self.time_to_decide_s, 0.5),
                "p95": _bootstrap(self.time_to_decide_s, 0.95),
            },
            **self._errors(self.decided, ""),
            "duration_s": {"median": _bootstrap(self.duration_s, 0.5)},
        } | self._later_errors()

    def _later_errors(self) -> dict[str, Any]:
        errors: dict[str, Any] = {}
        for after_s in self.scored_after_s:
            errors |= self._errors(self.decided & (self.times_s >= after_s), f"_after_{after_s:g}s")
        return errors

    def _errors(self, frames: Bool[np.ndarray, "S frames"], suffix: str) -> dict[str, Any]:
        return {
            f"median_position_error_m{suffix}": self._pooled(
                self.position_error_m, frames, lambda x: _quantile(x, 0.5)
            ),
            f"anees{suffix}": self._pooled(
                self.nees, frames, lambda x: float(np.mean(x)) if len(x) else np.nan
            ),
        }

    def _fraction(self, frames: np.ndarray) -> dict[str, Any]:
        wrong, counted = (self.wrong & frames).sum(axis=1), frames.sum(axis=1)
        picks = _resamples(len(wrong), _RESAMPLES)
        resampled = wrong[picks].sum(axis=1) / np.maximum(counted[picks].sum(axis=1), 1)
        low, high = np.percentile(resampled, [2.5, 97.5])
        if not wrong.any():
            # No drive was ever wrong: the upper bound on the share of drives that are.
            high = 1 - 0.05 ** (1 / len(wrong))
        return _measure(wrong.sum() / max(int(counted.sum()), 1), (low, high))

    @staticmethod
    def _pooled(
        values: np.ndarray, frames: np.ndarray, statistic: Callable[[np.ndarray], float]
    ) -> dict[str, Any]:
        if not frames.any():
            return _measure(np.nan, (np.nan, np.nan))
        drives = [v[chosen] for v, chosen in zip(values, frames, strict=True)]
        resampled = [
            statistic(np.concatenate([drives[i] for i in picks]))
            for picks in _resamples(len(drives), _POOLED_RESAMPLES)
        ]
        low, high = np.nanpercentile(resampled, [2.5, 97.5])
        return _measure(statistic(np.concatenate(drives)), (low, high))


def _bootstrap(values: np.ndarray, share: float) -> dict[str, Any]:
    """A quantile, with its interval, of values that have one entry per drive."""
    resampled = [_quantile(values[picks], share) for picks in _resamples(len(values), _RESAMPLES)]
    ordered = np.sort(resampled)  # infinite values included, which `percentile` cannot handle
    low, high = ordered[int(0.025 * _RESAMPLES)], ordered[int(0.975 * _RESAMPLES) - 1]
    return _measure(_quantile(values, share), (low, high))


def _resamples(drives: int, count: int) -> np.ndarray:
    """The drives in each resample, indices (count, drives)."""
    return np.random.default_rng(0).integers(0, drives, (count, drives))


def _measure(value: Any, interval: tuple[Any, Any]) -> dict[str, Any]:
    return {"value": float(value), "interval": [float(end) for end in interval]}


def _quantile(values: np.ndarray, share: float) -> float:
    """A quantile as an order statistic, so infinite values stay infinite."""
    if not len(values):
        return float("nan")
    return float(np.partition(values, k := min(int(share * len(values)), len(values) - 1))[k])
