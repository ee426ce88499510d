"""Follow the markers of one camera that its decoders do not read, and learn its exposure time.

What the filter expects and no decoder finds is followed by `track`, the largest first. A marker's
streak is its velocity in the image times the exposure time; where that time is not given, it is
learnt from the streaks of the markers that are followed.

A rolling shutter sees each row at its own time: corners of a marker that moves are taken back to
the time of the middle row, or are less certain by as much where its speed is not given.
"""

from collections import deque
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Float, Shaped

from jaxnav.core.models.camera import Camera
from jaxnav.detection.patch_fit import MOST_STREAK_PX
from jaxnav.detection.refine import mean_side_px
from jaxnav.detection.track import Target, Track, track
from jaxnav.detection.types import Detections, grey

MOST_FOLLOWED = 3  # markers of an image: each takes some milliseconds
_MOST_DISTURBED = 1  # of them: it takes up to 90 ms
_UNKNOWN_EXPOSURE_S = 0.01  # and as much more or less
_STREAK_SIGMA_PX, _STREAK_SHARE = 0.5, 0.3  # of a streak where the exposure time is known
_FAR_AHEAD_S, _AHEAD_SHARE = 0.1, 0.1  # a flow is trusted so long, and is off by so much
_UNKNOWN_ROW_TIME_S = 2e-5  # of common sensors 5 to 30 us
_FEWEST_STREAKS = 5  # from which the exposure time is learnt
_REMEMBERED = 31
_LEAST_STREAK_PX = 2.0  # from which it is learnt
_SAME_PX = 1.0  # two poses of one marker show it almost alike


class Tracker:
    """Follows markers through the images of one camera. For one thread at a time.

    Attributes:
        exposure_s: the exposure time, given or learnt from streaks; None if it is not known.
        row_time_s: from the exposure of one row to that of the next; None if it is not known.
    """

    def __init__(self, exposure_s: float | None = None, row_time_s: float | None = None):
        """Args:
        exposure_s: the exposure time, where it is known.
        row_time_s: from the exposure of one row to that of the next, where it is known.
        """
        self._is_given = False
        self.exposure_s: float | None = None
        self.row_time_s: float | None = None
        self.set_timing(exposure_s, row_time_s)
        self._exposures_s: deque[float] = deque(maxlen=_REMEMBERED)

    def set_timing(self, exposure_s: float | None, row_time_s: float | None) -> None:
        """Set the camera's timing; what is None stays as it was."""
        if exposure_s is not None:
            self.exposure_s, self._is_given = exposure_s, True
        if row_time_s is not None:
            self.row_time_s = row_time_s

    def follow(
        self,
        image: Shaped[np.ndarray, "..."],
        camera: Camera | None,
        keys: Sequence[tuple[str, int]],
        quads_px: Float[np.ndarray, "K 4 2"],
        radius_px: Float[np.ndarray, " K"],
        flow_px_s: Float[np.ndarray, "K 2"] | None = None,
        ahead_s: float = 0.0,
        decoded: Detections | None = None,
    ) -> Detections:
        """Follow the expected markers that were not decoded.

        Args:
            image: as in `Detector.detect`, like `camera`.
            keys: family and id of each expected marker; one may be expected in several places.
            quads_px: its expected corners, TL TR BR BL.
            radius_px: the farthest that it may be from there.
            flow_px_s: velocity of its centre in the image; None where that is not known.
            ahead_s: from the time of the expectation to that of the image.
            decoded: what decoders found in the image.

        Returns:
            The markers that were followed, without those that were decoded, at the time of the
            image's middle row.
        """
        if flow_px_s is not None:
            # A marker so fast could not be seen: the estimate jumped.
            streaks_px = self._likely_exposure_s * np.linalg.norm(flow_px_s, axis=1, keepdims=True)
            flow_px_s = np.where(streaks_px <= MOST_STREAK_PX, flow_px_s, np.nan)
        read = set() if decoded is None else set(zip(decoded.families, decoded.ids, strict=True))
        sides_px = [mean_side_px(quad) for quad in quads_px]
        places: dict[tuple[str, int], list[int]] = {}  # of each marker, the largest first
        for k in np.argsort(-np.asarray(sides_px), kind="stable"):
            if keys[k] not in read and np.isfinite(sides_px[k]) and np.isfinite(radius_px[k]):
                places.setdefault(keys[k], []).append(int(k))
        missing = list(places.items())[:MOST_FOLLOWED]
        targets = []
        for (family, marker_id), at in missing:
            streak_px, sigma_px = (0.0, 0.0), np.inf
            quads, within_px, flow = _distinct(quads_px[at]), float(np.max(radius_px[at])), at[0]
            if flow_px_s is not None and np.all(np.isfinite(flow_px_s[flow])):
                streak_px, sigma_px = self._streak(flow_px_s[flow])
                ahead_px = flow_px_s[flow] * min(max(ahead_s, -_FAR_AHEAD_S), _FAR_AHEAD_S)
                quads = quads + ahead_px
                within_px += _AHEAD_SHARE * float(np.hypot(*ahead_px))
            targets.append(Target(family, marker_id, quads, within_px, streak_px, sigma_px))
        if not targets:
            return Detections.concatenate([])
        image = grey(image)
        tracks = track(image, camera, targets, _MOST_DISTURBED)
        found = detections_of([one for one in tracks if one is not None])
        if flow_px_s is None:
            return found
        flows_px_s = [flow_px_s[at[0]] for _, at in missing]
        self._learn(flows_px_s, tracks)
        seen = [f for f, one in zip(flows_px_s, tracks, strict=True) if one is not None]
        return self._at_middle_row(
            found, np.nan_to_num(np.reshape(seen, (-1, 2))), (len(image) - 1) / 2
        )

    @property
    def learnt_exposure_s(self) -> float | None:
        """The exposure time by streaks; None where it was given, or is not known."""
        return None if self._is_given else self.exposure_s

    @property
    def _likely_exposure_s(self) -> float:
        return _UNKNOWN_EXPOSURE_S if self.exposure_s is None else self.exposure_s

    def _streak(self, flow_px_s: np.ndarray) -> tuple[tuple[float, float], float]:
        """The expected streak, px, and its standard deviation."""
        speed_px_s = float(np.hypot(*flow_px_s))
        exposure_s = self._likely_exposure_s
        share = 1.0 if self.exposure_s is None else _STREAK_SHARE
        streak = exposure_s * flow_px_s
        sigma_px = _STREAK_SIGMA_PX + share * exposure_s * speed_px_s
        return (float(streak[0]), float(streak[1])), sigma_px

    def _at_middle_row(
        self, found: Detections, flows_px_s: np.ndarray, middle_px: float
    ) -> Detections:
        """The corners at the time of the middle row."""
        after_px = found.corners_px[..., 1] - middle_px  # rows after it
        if self.row_time_s is not None:
            late_s = (self.row_time_s * after_px)[..., None]
            return replace(found, corners_px=found.corners_px - late_s * flows_px_s[:, None])
        speeds_px_s = np.linalg.norm(flows_px_s, axis=1)[:, None]
        unknown_px = _UNKNOWN_ROW_TIME_S * speeds_px_s * np.abs(after_px)
        return replace(found, sigma_px=np.hypot(found.sigma_px, unknown_px))

    def _learn(self, flows_px_s: Sequence[np.ndarray], tracks: Sequence[Track | None]) -> None:
        if self._is_given:
            return
        for flow_px_s, one in zip(flows_px_s, tracks, strict=False):
            speed = float(np.hypot(*flow_px_s))
            if one is None or not np.hypot(*one.streak_px) >= _LEAST_STREAK_PX or not speed > 0:
                continue
            self._exposures_s.append(abs(float(one.streak_px @ flow_px_s)) / speed**2)
        if len(self._exposures_s) >= _FEWEST_STREAKS:
            self.exposure_s = float(np.median(self._exposures_s))


def _distinct(quads_px: Float[np.ndarray, "H 4 2"]) -> Float[np.ndarray, "P 4 2"]:
    """The quadrilaterals without those that are almost the same as an earlier one."""
    distinct = [quads_px[0]]
    for quad in quads_px[1:]:
        if all(np.max(np.abs(quad - other)) > _SAME_PX for other in distinct):
            distinct.append(quad)
    return np.stack(distinct)


def detections_of(tracks: Sequence[Track]) -> Detections:
    """Detections of the markers that were followed."""
    return Detections(
        ids=np.array([one.marker_id for one in tracks], int),
        corners_px=np.array([one.corners_px for one in tracks], float).reshape(-1, 4, 2),
        sigma_px=np.array([one.sigma_px for one in tracks], float).reshape(-1, 4),
        refined=np.ones(len(tracks), bool),
        families=tuple(one.family for one in tracks),
    )
