"""From frames to what they tell: which to use, and what is wrong with the others."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from jaxnav.detection.observe import Observed, observe
from jaxnav.detection.types import Detections
from jaxnav.files.ranges import RANGES
from jaxnav.markers import MarkerMap
from jaxnav.runtime.flags import Fault
from jaxnav.runtime.history import Told
from jaxnav.runtime.stamps import Stamps

FROZEN_AFTER = 3  # frames with the very same corners, or pictures
_NO_FAULT = Fault(0)
_MOST_PX = RANGES["corner_px"].most  # beyond, a corner is as good as infinite
_NONE = Detections.concatenate([])

# Whether a camera shows what it should not see any more: camera, stamp_ns, now_ns, corners_px
# (M, 4, 2), visible (M,), their sigma_px; see `Standstill.frozen`.
Frozen = Callable[[int, int, int, np.ndarray, np.ndarray, float], bool]


@dataclass(frozen=True)
class Sighted:
    """What one camera's frame shows.

    Attributes:
        camera: index in the rig.
        stamp_ns: as the camera says.
        detections: None where the frame could not be used.
        faults: of the frame, found by whoever looked at its pixels.
    """

    camera: int
    stamp_ns: int
    detections: Detections | None
    faults: Fault = _NO_FAULT


class Frames:
    """The frames of a drive, camera by camera.

    Attributes:
        newest_ns: when each camera last gave a frame that could be used, None: never.
    """

    def __init__(self, cameras: int, markers: MarkerMap, corner_sigma_px: float | None = None):
        """Args:
        corner_sigma_px: of every corner along one axis; by default as each detection says.
        """
        self.newest_ns: list[int | None] = [None] * cameras
        self._newest_before_ns = list(self.newest_ns)
        self._markers, self._corner_sigma_px = markers, corner_sigma_px
        self._stamps = [Stamps() for _ in range(cameras)]
        self._corners: list[tuple[bytes, int]] = [(b"", 0)] * cameras  # and how often the same

    def refused(self) -> None:
        """What was told last came too late for the filter: it is as if it had not come."""
        self.newest_ns = list(self._newest_before_ns)

    def told(
        self, frames: Sequence[Sighted], now_ns: int, frozen: Frozen | None = None
    ) -> tuple[Told | None, int, Fault]:
        """What frames tell, when it was true, and what is wrong with them.

        Args:
            frozen: asked of each camera that shows markers; None: nobody knows.
        """
        self._newest_before_ns = list(self.newest_ns)
        if not frames:
            return None, now_ns, _NO_FAULT
        faults = _NO_FAULT
        found = [_NONE] * len(self.newest_ns)
        stamps_ns: dict[int, int] = {}
        for frame in frames:
            if frame.faults:
                faults |= frame.faults
            stamps = self._stamps[frame.camera]
            jumps = stamps.jumps
            stamp_ns = stamps.take(frame.stamp_ns, now_ns)
            if stamp_ns is None:
                faults |= Fault.STAMP_INVALID
                continue
            if stamps.jumps > jumps:
                faults |= Fault.CLOCK_JUMPED
            if frame.detections is None:
                continue
            if self._frozen(frame.camera, frame.detections):
                faults |= Fault.FRAME_FROZEN
                continue
            self.newest_ns[frame.camera] = max(stamp_ns, self.newest_ns[frame.camera] or 0)
            if len(frame.detections):
                found[frame.camera], stamps_ns[frame.camera] = frame.detections, stamp_ns
        seen = observe(found, self._markers)
        if seen.unknown:
            faults |= Fault.UNKNOWN_MARKER
        if seen.duplicates:
            faults |= Fault.DUPLICATE_MARKER
        finite = (np.abs(seen.corners_px) <= _MOST_PX).all(axis=(2, 3))  # NaN is not
        finite &= (np.isfinite(seen.sigma_px) & (seen.sigma_px > 0)).all(axis=2)
        if np.any(seen.visible & ~finite):
            faults |= Fault.CORNERS_NOT_FINITE
        visible = seen.visible & finite
        taken_ns, frozen_seen = self._leave_out_frozen(seen, visible, stamps_ns, now_ns, frozen)
        faults |= frozen_seen
        sigma_px: np.ndarray | float = seen.sigma_px
        if self._corner_sigma_px is not None:
            sigma_px = self._corner_sigma_px
        if taken_ns is None or not visible.any():
            return None, now_ns, faults
        told = Told(
            corners_px=np.where(visible[..., None, None], seen.corners_px, 0),
            visible=visible,
            sigma_px=np.where(visible[..., None], sigma_px, np.ones_like(seen.sigma_px)),
        )
        return told, taken_ns, faults

    def _leave_out_frozen(
        self,
        seen: Observed,
        visible: np.ndarray,
        stamps_ns: dict[int, int],
        now_ns: int,
        frozen: Frozen | None,
    ) -> tuple[int | None, Fault]:
        """When what is left was true, and whether a camera was left out of `visible`."""
        taken_ns, faults = None, _NO_FAULT
        for camera, stamp_ns in stamps_ns.items():
            shown, corners_px = visible[camera], seen.corners_px[camera]
            if frozen is not None and shown.any():
                sigma_px = float(seen.sigma_px[camera][shown].max())
                if frozen(camera, stamp_ns, now_ns, corners_px, shown.copy(), sigma_px):
                    faults, visible[camera] = Fault.FRAME_FROZEN, False
                    self.newest_ns[camera] = self._newest_before_ns[camera]
                    continue
            taken_ns = stamp_ns
        return taken_ns, faults

    def _frozen(self, camera: int, detections: Detections) -> bool:
        """Whether a camera shows the very same corners once too often."""
        is_comparable = len(detections) and np.isfinite(detections.corners_px).all()
        shown = detections.corners_px.tobytes() if is_comparable else b""
        last, times = self._corners[camera]
        times = times + 1 if shown and shown == last else 1
        self._corners[camera] = shown, times
        return times >= FROZEN_AFTER
