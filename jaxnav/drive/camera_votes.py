"""Take its vote from a camera that does not see markers where the estimate and another camera do.

    votes.note_contradiction(stamp_ns)  # frames that the filter did not expect
    if votes.open(stamp_ns):  # only then are the corners projected
        votes.count(data, due_px, stamp_ns)
    data = votes.remove_outvoted(data)

A camera that was knocked is off by more than the filter learns of one: its
frames, and those that it shares with others, fit no pose, and the filter would give up the right
one. A vehicle that was carried off is where no camera expects it. So an accusation counts only once
another camera has seen markers where they should be, since.
"""

import math

import jax
import numpy as np
from jaxtyping import Bool, Float

from jaxnav.core.navigator import Navigator
from jaxnav.drive.history import EventData

_OFTEN = 5  # half of the frames after which the filter gives up, see `max_rejections`
_TOGETHER_NS = 500_000_000  # cameras that take turns look within this time
_OPEN_NS = 1_000_000_000  # this long after a contradiction
_OFF_RAD = math.radians(5.0)  # less than that the filter learns
_FARTHER = 3.0  # than a camera that sees as expected: an estimate that is off itself accuses none
_LONG_AGO_NS = -(1 << 62)


class CameraVotes:
    """The votes against each camera in one drive."""

    def __init__(self, navigator: Navigator):
        self._names = np.array(navigator.rig.names)
        axis_px = jax.vmap(lambda camera: camera.axis_px)(navigator.rig.cameras)
        self._most_px = math.tan(_OFF_RAD) * np.asarray(axis_px).mean(axis=1)
        count = len(self._names)
        self._votes = np.zeros(count, int)
        self._off_px, self._off_ns = np.zeros(count), np.full(count, _LONG_AGO_NS)
        self._contradicted_ns = _LONG_AGO_NS

    def note_contradiction(self, stamp_ns: int) -> None:
        """Note corners that the filter did not expect."""
        self._contradicted_ns = stamp_ns

    def open(self, stamp_ns: int) -> bool:
        """Whether there is anything to vote on."""
        return stamp_ns - self._contradicted_ns < _OPEN_NS or bool(self._outvoted.any())

    def count(self, data: EventData, due_px: Float[np.ndarray, "C M 4 2"], stamp_ns: int) -> None:
        """Count the votes of a frame.

        Args:
            data: with corners.
            due_px: where they should be by the estimate.
        """
        corners_px, visible = data.corners_px, data.visible
        assert corners_px is not None
        assert visible is not None
        apart_px = np.linalg.norm(corners_px - due_px, axis=3).max(axis=2)
        off_px = np.where(visible, apart_px, 0).max(axis=1)
        in_view, off = visible.any(axis=1), ~(off_px <= self._most_px)
        self._off_px[off], self._off_ns[off] = off_px[off], stamp_ns
        as_expected = in_view & ~off
        if as_expected.any():
            recent = np.abs(stamp_ns - self._off_ns) < _TOGETHER_NS
            accused = recent & ~(self._off_px <= _FARTHER * off_px[as_expected].min())
            self._votes = np.clip(self._votes + accused - as_expected, 0, 2 * _OFTEN)
            self._off_ns[recent] = _LONG_AGO_NS

    @property
    def outvoted(self) -> tuple[str, ...]:
        """The names of the cameras without a vote."""
        return tuple(self._names[self._outvoted].tolist())

    def remove_outvoted(self, data: EventData) -> EventData | None:
        """The data without these cameras; None where that leaves nothing."""
        assert data.visible is not None
        hidden = self._outvoted & data.visible.any(axis=1)
        if not hidden.any():
            return data
        return data.hiding(np.broadcast_to(hidden[:, None], data.visible.shape))

    @property
    def _outvoted(self) -> Bool[np.ndarray, " C"]:
        return self._votes >= _OFTEN
