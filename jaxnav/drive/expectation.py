"""Where each camera should see markers: by the decided pose, else by every live hypothesis."""

from dataclasses import dataclass, replace

import jax
import numpy as np

from jaxnav.core.navigator import Navigator
from jaxnav.detection.observe import marker_keys
from jaxnav.drive.compiled_step import strip_static
from jaxnav.drive.expect import Expected, expect_corners, likely_poses
from jaxnav.drive.pilot import Outcome
from jaxnav.drive.seeing import Region

_MOST_PLACES = 4  # hypotheses
_APART_NS, _TOO_FAR_NS = 15_000_000, 200_000_000  # of two poses that tell a velocity
_MIN_COVARIANCE = np.diag([0.01**2, 0.01**2, np.deg2rad(0.5) ** 2])  # regions are not narrower


@dataclass(frozen=True)
class _Belief:
    """Where the vehicle may be: the reported pose once it is decided, else one a hypothesis.

    Attributes:
        wxyz_xyz, covariance: (H, 7) and (H, 3, 3).
        now_ns: when they hold.
        before: the pose a little earlier; None where it was not decided.
    """

    wxyz_xyz: np.ndarray
    covariance: np.ndarray
    now_ns: int
    decided: bool
    before: "_Belief | None"


class Expectation:
    """The regions of a drive. One thread updates them, those that look for markers ask at any
    time."""

    def __init__(self, navigator: Navigator):
        """Compile now: the threads that look for markers are watched."""
        self._unnamed = strip_static(navigator)  # as compiled programs have it
        dtype = np.asarray(navigator.corner_sigma_px).dtype
        self._min_covariance = _MIN_COVARIANCE.astype(dtype)
        self._keys = marker_keys(navigator.markers)
        self._belief: _Belief | None = None
        # Of a belief: where each of its poses expects the markers, and how they move.
        self._known: tuple[_Belief, list[Expected], np.ndarray | None] | None = None
        self._expected(np.array([1, 0, 0, 0, 0, 0, 0], dtype), self._min_covariance)

    def update(self, outcome: Outcome) -> None:
        """Take what is believed now."""
        # One assignment, since other threads read it.
        self._belief = self._believed(outcome) if outcome.output.located else None

    def region(self, camera: int) -> Region | None:
        """Where a camera should see markers; None where no pose is known."""
        belief = self._belief
        if belief is None:
            return None
        known = self._known
        if known is None or known[0] is not belief:  # the same for all cameras of a set
            places = zip(belief.wxyz_xyz, belief.covariance, strict=True)
            expected = [self._expected(*place) for place in places]
            known = self._known = belief, expected, self._flow_px_s(belief, expected[0])
        quads_px, visible, radius_px = (
            np.concatenate([np.asarray(part)[camera] for part in parts])
            for parts in zip(*known[1], strict=True)
        )
        flow_px_s = None if known[2] is None else known[2][camera][visible]
        keys = self._keys * len(known[1])
        seen = tuple(key for key, sees in zip(keys, visible, strict=True) if sees)
        stamp_ns, decided = belief.now_ns, belief.decided
        return Region(quads_px[visible], radius_px[visible], seen, flow_px_s, stamp_ns, decided)

    def _believed(self, outcome: Outcome) -> _Belief:
        output, now_ns = outcome.output, outcome.now_ns
        if not output.decided:
            poses, covariances = likely_poses(outcome.belief.bank, _MOST_PLACES)
            return _Belief(poses, covariances + self._min_covariance, now_ns, False, None)
        before = self._belief
        if before is not None and before.before is not None and now_ns - before.now_ns < _APART_NS:
            before = before.before
        return _Belief(
            np.asarray(output.T_world_vehicle.wxyz_xyz)[None],
            np.asarray(output.pose_covariance + self._min_covariance)[None],
            now_ns,
            True,
            replace(before, before=None) if before is not None and before.decided else None,
        )

    def _flow_px_s(self, belief: _Belief, expected: Expected) -> np.ndarray | None:
        """Velocities (C, M, 2) of the markers' centres in the images, from two poses in a row."""
        before = belief.before
        if before is None or not _APART_NS <= belief.now_ns - before.now_ns <= _TOO_FAR_NS:
            return None
        earlier = self._expected(before.wxyz_xyz[0], before.covariance[0])
        moved_px = np.mean(expected.quads_px - earlier.quads_px, axis=-2)
        return np.asarray(moved_px / ((belief.now_ns - before.now_ns) / 1e9))

    def _expected(self, wxyz_xyz: np.ndarray, covariance: np.ndarray) -> Expected:
        rig, markers = self._unnamed.rig, self._unnamed.markers
        return Expected(*jax.device_get(expect_corners(rig, markers, wxyz_xyz, covariance)))
