"""Leave out markers that others contradict, and ids that cameras see at contradicting places."""

import math
from itertools import combinations

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from jaxnav.core.models.rig import CameraRig
from jaxnav.core.navigator import Navigator
from jaxnav.core.pose.candidates import LEAST_MARKERS
from jaxnav.core.pose.ippe import ippe_from_rays
from jaxnav.drive.history import Sighting
from jaxnav.drive.standstill import Way, between
from jaxnav.files.executables import kept

_OFTEN = 10  # frames with a contradiction by the others minus frames without one
_TOGETHER_NS = 500_000_000  # cameras that take turns look within this time
# Two cameras may see a marker this share of its distance apart: 17 degrees, where the filter learns
# of a camera that is off by 10, or a range that differs by 30 %; and cameras measured by hand.
_APART_SHARE, _APART_M = 0.3, 0.05
_SIGMAS = 3.0  # of the noise of both ranges beside it
# Frames after which only what agrees gives an id or a vote back: half of those after which the
# filter gives up, see `max_rejections`.
_LASTING = 5
_LONG_AGO_NS = -(1 << 62)
_OPEN_NS = 1_000_000_000  # this long after a contradiction a camera is judged
_OFF_RAD = math.radians(5.0)  # less than that the filter learns of a camera
_FARTHER = 3.0  # than a camera that sees as expected: an estimate that is off itself accuses none


class MarkerVotes:
    """The votes against each marker in one drive. Only frames with enough markers to vote count."""

    def __init__(self, ids: tuple[int, ...]):
        """Args:
        ids: ids of the map's markers, in its order.
        """
        self._ids = ids
        self._times = np.zeros(len(ids), int)

    def count(self, data: Sighting, outvoted: Bool[np.ndarray, " M"]) -> None:
        """Count the votes of a frame.

        Args:
            outvoted: (M,), which markers the filter found to be outvoted.
        """
        in_view = data.visible.any(axis=0)
        if in_view.sum() >= LEAST_MARKERS:
            times = self._times + np.where(outvoted, 1, -1) * in_view
            self._times = np.clip(times, 0, 2 * _OFTEN)

    @property
    def outvoted(self) -> tuple[int, ...]:
        """The ids of the markers that have more votes against them than for them."""
        return tuple(self._ids[index] for index in np.flatnonzero(self._times))

    def remove_outvoted(self, data: Sighting) -> Sighting | None:
        """The data without markers that were often outvoted, if too few are in view to vote.

        None where that leaves nothing.
        """
        can_vote = data.visible.any(axis=0).sum() >= LEAST_MARKERS
        return data if can_vote else data.hiding(self._times[None] >= _OFTEN)


class CameraVotes:
    """The votes against each camera in one drive.

    A camera that was knocked is off by more than the filter learns of one: its frames, and those
    that it shares with others, fit no pose, and the filter would give up the right one. A vehicle
    that was carried off is where no camera expects it. So an accusation counts only once another
    camera has seen markers where they should be, since.
    """

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
        """Whether there is anything to vote on: only then are corners projected for `count`."""
        return stamp_ns - self._contradicted_ns < _OPEN_NS or bool(self._outvoted.any())

    def count(self, data: Sighting, due_px: Float[np.ndarray, "C M 4 2"], stamp_ns: int) -> None:
        """Count the votes of a frame.

        Args:
            due_px: where they should be by the estimate.
        """
        visible = data.visible
        apart_px = np.linalg.norm(data.corners_px - due_px, axis=3).max(axis=2)
        off_px = np.where(visible, apart_px, 0).max(axis=1)
        in_view, off = visible.any(axis=1), ~(off_px <= self._most_px)
        self._off_px[off], self._off_ns[off] = off_px[off], stamp_ns
        as_expected = in_view & ~off
        if as_expected.any():
            recent = np.abs(stamp_ns - self._off_ns) < _TOGETHER_NS
            accused = recent & ~(self._off_px <= _FARTHER * off_px[as_expected].min())
            self._votes = np.clip(self._votes + accused - as_expected, 0, 2 * _LASTING)
            self._off_ns[recent] = _LONG_AGO_NS

    @property
    def outvoted(self) -> tuple[str, ...]:
        """The names of the cameras without a vote."""
        return tuple(self._names[self._outvoted].tolist())

    def remove_outvoted(self, data: Sighting) -> Sighting | None:
        """The data without these cameras; None where that leaves nothing."""
        return data.hiding(self._outvoted[:, None])

    @property
    def _outvoted(self) -> Bool[np.ndarray, " C"]:
        return self._votes >= _LASTING


@kept
def sighted_places(
    rig: CameraRig, size_m: Float[Array, " M"], corners_px: Float[Array, "C M 4 2"]
) -> Float[Array, "C M 3"]:
    """Where each sighting by itself has its marker's centre in the vehicle's frame, m.

    The two poses of a square differ in how it is turned, not in where it is.
    """

    def one(camera: Array, corners_px: Array, size_m: Array) -> Array:
        lens, T_camera_vehicle = jax.tree.map(
            lambda leaf: leaf[camera], (rig.cameras, rig.Ts_camera_vehicle)
        )
        Ts_camera_marker = ippe_from_rays(lens.unproject(corners_px), size_m)
        place_m: Array = T_camera_vehicle.inverse() @ Ts_camera_marker.translation()[0]
        return place_m

    each = jax.vmap(jax.vmap(one, (None, 0, 0)), (0, 0, None))
    places_m: Array = each(jnp.arange(len(rig)), corners_px, size_m)
    return places_m


class Twins:
    """A drive's watch for one id that two cameras see at contradicting places: a copy, a mirror.

    Nothing in such a frame says which is right, or whether a camera is not where its file says. So
    the id is left out of all cameras. Where a sure estimate does, it judges (see `CameraVotes`).
    """

    def __init__(self, navigator: Navigator):
        rig, markers = navigator.rig, navigator.markers
        shape = len(rig), len(markers.ids)
        self._rig, self._size_m = rig, markers.size_m
        self._dtype = np.asarray(navigator.corner_sigma_px).dtype
        self._corners_px = np.zeros((*shape, 4, 2), self._dtype)
        # Of each marker, of each camera; lists, for single numbers are asked for.
        self._stamps_ns = [[_LONG_AGO_NS] * shape[0] for _ in range(shape[1])]
        self._sigma_px, self._seen_m = np.ones(shape), np.zeros((*shape, 3))
        # When the first camera's look last contradicted the second's before it.
        self._after_ns = np.full((shape[0], *shape), _LONG_AGO_NS)
        self._votes, self._last_ns = [0] * shape[1], [_LONG_AGO_NS] * shape[1]

    def warm_up(self) -> None:
        """Compile the program without changing anything."""
        if len(self._rig) > 1:
            sighted_places(self._rig, self._size_m, self._corners_px)

    def seen(self, now_ns: int) -> bool:
        """Whether there are such ids."""
        return max(self._votes) >= _LASTING or now_ns - self.last_ns < _TOGETHER_NS

    @property
    def last_ns(self) -> int:
        """Stamp of the last contradiction."""
        return max(self._last_ns)

    def remove_twins(
        self, data: Sighting, stamp_ns: int, way: Way, judged: bool = False
    ) -> Sighting | None:
        """The data without ids at contradicting places; None where that leaves nothing.

        Args:
            way: of the vehicle by its odometer, which has moved between looks.
            judged: a sure estimate judges contradictions.
        """
        visible = data.visible
        if len(visible) < 2:
            return data
        lanes = np.argwhere(visible).tolist()
        for camera, marker in lanes:
            self._corners_px[camera, marker] = data.corners_px[camera, marker]
            self._sigma_px[camera, marker] = data.sigma_px[camera, marker].max()
            self._stamps_ns[marker][camera] = stamp_ns
        shared: dict[int, list[int]] = {}  # the cameras that have just seen a marker
        for _, marker in lanes:
            stamps_ns = enumerate(self._stamps_ns[marker])
            recent = [camera for camera, ns in stamps_ns if abs(stamp_ns - ns) < _TOGETHER_NS]
            if len(recent) > 1:
                shared[marker] = recent
        if shared or lanes[0][0] != lanes[-1][0]:
            places_m = sighted_places(self._rig, self._size_m, self._corners_px)
            self._seen_m = np.asarray(places_m, float)
        for marker, cameras in shared.items():
            self._compare(marker, cameras, stamp_ns, way, judged)
        twins = [
            votes >= _LASTING or abs(stamp_ns - last_ns) < _TOGETHER_NS
            for votes, last_ns in zip(self._votes, self._last_ns, strict=True)
        ]
        return data.hiding(np.array(twins)[None])

    def place_m(self, camera: int, marker: int) -> list[float]:
        """Where a sighting has its marker; known while several cameras are in view."""
        place_m: list[float] = self._seen_m[camera, marker].tolist()
        return place_m

    def _compare(
        self, marker: int, cameras: list[int], stamp_ns: int, way: Way, judged: bool
    ) -> None:
        now, stamps_ns = way.at(stamp_ns), self._stamps_ns[marker]
        # A range is as noisy as the longest side in the image.
        corners_px = self._corners_px[:, marker]
        sides_px = np.linalg.norm(corners_px - np.roll(corners_px, 1, axis=1), axis=2).max(axis=1)
        noise = self._sigma_px[:, marker] / np.maximum(sides_px, 1.0)
        places_m: list[tuple[int, np.ndarray]] = []
        for camera in cameras:
            at_m = self._seen_m[camera, marker]
            if stamps_ns[camera] != stamp_ns:
                then = way.at(stamps_ns[camera])
                if now is None or then is None:
                    continue
                ahead_m, left_m, _ = between(between(then, now), (at_m[0], at_m[1], 0.0))
                at_m = np.array([ahead_m, left_m, at_m[2]])
            places_m.append((camera, at_m))
        for (one, one_m), (other, other_m) in combinations(places_m, 2):
            if stamp_ns not in (stamps_ns[one], stamps_ns[other]):
                continue
            farther_m = max(np.linalg.norm(one_m), np.linalg.norm(other_m))
            share = _APART_SHARE + _SIGMAS * float(np.linalg.norm(noise[[one, other]]))
            if np.linalg.norm(one_m - other_m) <= _APART_M + share * farther_m:
                self._votes[marker] = max(self._votes[marker] - 1, 0)
            elif not judged and self._in_turn(one, other, marker, stamp_ns):
                self._votes[marker] = min(self._votes[marker] + 1, 2 * _LASTING)
                self._last_ns[marker] = stamp_ns

    def _in_turn(self, one: int, other: int, marker: int, stamp_ns: int) -> bool:
        """Whether two looks that contradict each other are of one time, or follow others of these
        cameras that did in the other order: a vehicle that was carried off makes one contradiction.
        """
        of_one_ns, of_other_ns = self._stamps_ns[marker][one], self._stamps_ns[marker][other]
        if of_one_ns == of_other_ns:
            return True
        newer, older = (one, other) if of_one_ns == stamp_ns else (other, one)
        self._after_ns[newer, older, marker] = stamp_ns
        return bool(stamp_ns - self._after_ns[older, newer, marker] < _TOGETHER_NS)
