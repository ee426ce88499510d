"""Select the frames to fuse, and report what is wrong with the others."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

from jaxnav.core.models.markers import MarkerMap
from jaxnav.detection.observe import CornerLanes, observe
from jaxnav.detection.types import Detections
from jaxnav.drive.flags import Fault
from jaxnav.drive.history import Sighting
from jaxnav.drive.stamps import Stamps
from jaxnav.files.ranges import is_within

FROZEN_AFTER = 3  # frames in a row with exactly the same corners or picture
_NO_FAULT = Fault(0)
_NONE = Detections.concatenate([])

# Whether a camera shows an old picture. Arguments: camera, stamp_ns, now_ns, corners_px, visible,
# their sigma_px; see `Standstill.is_frozen`.
Frozen = Callable[[int, int, int, Float[np.ndarray, "M 4 2"], Bool[np.ndarray, " M"], float], bool]


@dataclass(frozen=True)
class FrameDetections:
    """The detections in one camera's frame.

    Attributes:
        camera: index in the rig.
        stamp_ns: the camera's own timestamp.
        detections: None where the frame could not be used.
        faults: faults of the frame, found by the search of its pixels.
    """

    camera: int
    stamp_ns: int
    detections: Detections | None
    faults: Fault = _NO_FAULT


class FrameIntake:
    """The frames of a drive, camera by camera.

    Attributes:
        newest_ns: time of each camera's last usable frame, None: never.
    """

    def __init__(self, cameras: int, markers: MarkerMap, corner_sigma_px: float | None = None):
        """Args:
        corner_sigma_px: of every corner along one axis; by default as each detection says.
        """
        self.newest_ns: list[int | None] = [None] * cameras
        self._newest_before_ns = list(self.newest_ns)
        self._markers, self._corner_sigma_px = markers, corner_sigma_px
        self._stamps = [Stamps() for _ in range(cameras)]
        self._corners: list[tuple[bytes, int]] = [(b"", 0)] * cameras  # last, and its repetitions

    def forget_last(self) -> None:
        """Treat the last frames, which came too late for the filter, as if they had not come."""
        self.newest_ns = list(self._newest_before_ns)

    def check(
        self, frames: Sequence[FrameDetections], now_ns: int, frozen: Frozen | None = None
    ) -> tuple[Sighting | None, int, Fault]:
        """The data of frames, their stamp, and the faults found in them.

        Args:
            frozen: called for each camera that shows markers; None: not checked.
        """
        self._newest_before_ns = list(self.newest_ns)
        if not frames:
            return None, now_ns, _NO_FAULT
        faults = _NO_FAULT
        detections = [_NONE] * len(self.newest_ns)
        stamps_ns: dict[int, int] = {}
        for frame in frames:
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
                detections[frame.camera], stamps_ns[frame.camera] = frame.detections, stamp_ns
        seen = observe(detections, self._markers)
        for is_there, fault in (
            (seen.unknown, Fault.UNKNOWN_MARKER),
            (seen.duplicates, Fault.DUPLICATE_MARKER),
            (seen.mirrored, Fault.CORNERS_MIRRORED),
            (hide_nowhere(seen), Fault.CORNERS_NOT_FINITE),
        ):
            if is_there:
                faults |= fault
        taken_ns, frozen_seen = self._leave_out_frozen(seen, stamps_ns, now_ns, frozen)
        if frozen_seen:
            faults |= Fault.FRAME_FROZEN
        if taken_ns is None or not seen.visible.any():
            return None, now_ns, faults
        if self._corner_sigma_px is not None:
            seen.sigma_px[seen.visible] = self._corner_sigma_px
        sighting = Sighting(
            corners_px=seen.corners_px, visible=seen.visible, sigma_px=seen.sigma_px
        )
        return sighting, taken_ns, faults

    def _leave_out_frozen(
        self, seen: CornerLanes, stamps_ns: dict[int, int], now_ns: int, frozen: Frozen | None
    ) -> tuple[int | None, bool]:
        """Hide frozen cameras; return the stamp of the others, and whether one was hidden."""
        taken_ns, left_out = None, False
        for camera, stamp_ns in stamps_ns.items():
            shown, corners_px = seen.visible[camera], seen.corners_px[camera]
            if frozen is not None and shown.any():
                sigma_px = float(seen.sigma_px[camera][shown].max())
                if frozen(camera, stamp_ns, now_ns, corners_px, shown.copy(), sigma_px):
                    left_out = True
                    _hide(seen, (camera,))
                    self.newest_ns[camera] = self._newest_before_ns[camera]
                    continue
            taken_ns = stamp_ns
        return taken_ns, left_out

    def _frozen(self, camera: int, detections: Detections) -> bool:
        """Whether a camera has shown exactly the same corners FROZEN_AFTER times in a row."""
        shown = detections.corners_px.tobytes() if len(detections) else b""
        last, times = self._corners[camera]
        repeats = shown and shown == last and np.isfinite(detections.corners_px).all()
        times = times + 1 if repeats else 1
        self._corners[camera] = shown, times
        return times >= FROZEN_AFTER


def hide_nowhere(seen: CornerLanes) -> bool:
    """Hide markers whose corners or sigmas are out of range; return whether there are any."""
    if _are_within(seen.corners_px, seen.sigma_px):
        return False
    for lane in zip(*np.nonzero(seen.visible), strict=True):
        if not _are_within(seen.corners_px[lane], seen.sigma_px[lane]):
            _hide(seen, lane)
    return True


def _are_within(corners_px: np.ndarray, sigma_px: np.ndarray) -> bool:
    """Whether corners and sigmas are in range; NaN and infinities are not."""
    near = is_within("corner_px", corners_px).all()
    return bool(near and is_within("seen_sigma_px", sigma_px).all())


def _hide(seen: CornerLanes, lane: tuple[int, ...]) -> None:
    """Make a lane of the observation empty."""
    seen.visible[lane], seen.corners_px[lane], seen.sigma_px[lane] = False, 0, 1
