"""Poses of a freely moving rig by other software's odometry, in a frame of its own.

A visual-inertial odometry, a lidar or a T265 tells where its body is in a frame that drifts against
the map. Only the motion between two times is used of it.
"""

from collections import deque
from dataclasses import dataclass, field, replace

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.spatial.transform import Rotation, Slerp

from jaxnav.core.models.vehicle import OdometryErrors, default_odometry_sigma
from jaxnav.files.poses import inverse, matrix
from jaxnav.files.ranges import is_within

_MAX_GAP_S = 0.5  # between two poses; what happened in a longer one is not known
_KEPT = 1024  # poses of a track that grows: 2 s at 500 Hz
# So many stamps in a row that are that far behind: their clock was set back, or one was absurd.
SET_BACK_AFTER, SET_BACK_NS = 10, 1_000_000_000


@dataclass(frozen=True)
class OdometryTrack:
    """N poses of the odometry's body in its own frame.

    Attributes:
        stamps_ns: (N,), increasing.
        T_odom_sensor: (N, 7) wxyz xyz, of the body whose motion it tells.
        T_vehicle_sensor: (7,) where that body is in the vehicle's frame.
        sigma: (4,) how far off its scale (1) and its direction on the vehicle (rad) may be.
    """

    stamps_ns: Int[np.ndarray, " N"]
    T_odom_sensor: Float[np.ndarray, "N 7"]
    T_vehicle_sensor: Float[np.ndarray, " 7"]
    sigma: Float[np.ndarray, " 4"] = field(default_factory=default_odometry_sigma)

    def errors(self) -> OdometryErrors | None:
        """The errors that a filter keeps of it; None: it is exact but for its drift."""
        if not self.sigma.any():
            return None
        return OdometryErrors.create(self.sigma, self.T_vehicle_sensor[4:])

    def earlier_by(self, delay_s: float) -> "OdometryTrack":
        """The track where its poses were taken so long before their stamps."""
        return replace(self, stamps_ns=self.stamps_ns - round(delay_s * 1e9))

    def twists(self, stamps_ns: Int[np.ndarray, " F"]) -> Float[np.ndarray, "F 6"]:
        """The vehicle's mean twist before each stamp since the one before it.

        Returns:
            (F, 6) m/s and rad/s in the vehicle's axes, with exp(twist dt) the motion; NaN where a
            pose of either time is not known, where nothing moves like that, and for the first.
        """
        twists = np.full((len(stamps_ns), 6), np.nan)
        known, places = self._at(stamps_ns)
        dt_s = np.diff(stamps_ns) / 1e9
        rows = np.flatnonzero(known[1:] & known[:-1] & (dt_s > 0))
        steps = np.linalg.inv(places[rows]) @ places[rows + 1]
        found = _logarithms(steps) / dt_s[rows, None]
        can_be = is_within("speed_mps", found[:, :3]) & is_within("turn_radps", found[:, 3:])
        twists[rows + 1] = np.where(can_be.all(axis=1, keepdims=True), found, np.nan)
        return twists

    def rotations(
        self, stamps_ns: Int[np.ndarray, " F"]
    ) -> tuple[Bool[np.ndarray, " F"], Rotation]:
        """Which of the times are between two poses that are near, and R_odom_vehicle (F,)."""
        known, T_odom_vehicle = self._at(stamps_ns)
        return known, Rotation.from_matrix(T_odom_vehicle[:, :3, :3])

    def _at(self, stamps_ns: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Which of the times are between two poses that are near, and T_odom_vehicle (F, 4, 4)."""
        T = np.tile(np.eye(4), (len(stamps_ns), 1, 1))
        if len(self.stamps_ns) < 2:
            return np.zeros(len(stamps_ns), bool), T
        after = np.clip(np.searchsorted(self.stamps_ns, stamps_ns), 1, len(self.stamps_ns) - 1)
        before_ns, after_ns = self.stamps_ns[after - 1], self.stamps_ns[after]
        known = (before_ns <= stamps_ns) & (stamps_ns <= after_ns)
        known &= after_ns - before_ns <= _MAX_GAP_S * 1e9
        times_s = (self.stamps_ns - self.stamps_ns[0]) / 1e9
        asked_s = np.clip((stamps_ns - self.stamps_ns[0]) / 1e9, 0, times_s[-1])
        turns = Slerp(times_s, Rotation.from_quat(np.roll(self.T_odom_sensor[:, :4], -1, axis=1)))
        T[:, :3, :3] = turns(asked_s).as_matrix()
        for axis in range(3):
            T[:, axis, 3] = np.interp(asked_s, times_s, self.T_odom_sensor[:, 4 + axis])
        return known, T @ matrix(inverse(self.T_vehicle_sensor))


class GrowingTrack:
    """The last poses of an odometry that goes on. For one thread at a time."""

    def __init__(self, T_vehicle_sensor: Float[np.ndarray, " 7"], delay_s: float = 0.0):
        """See `OdometryTrack`; `delay_s` as in its `earlier_by`."""
        self._delay_ns = round(delay_s * 1e9)
        self._T_vehicle_sensor = T_vehicle_sensor
        self._poses: deque[tuple[int, np.ndarray]] = deque(maxlen=_KEPT)
        self._behind = 0  # poses in a row

    def add(self, stamp_ns: int, T_odom_sensor: Float[np.ndarray, " 7"]) -> None:
        """Take a pose (7,) wxyz xyz; one that is older than the last is left out."""
        taken_ns = stamp_ns - self._delay_ns
        behind = self.reaches(taken_ns + SET_BACK_NS)
        self._behind = self._behind + 1 if behind else 0
        if self._behind >= SET_BACK_AFTER:
            self._poses.clear()
        if not self.reaches(taken_ns):
            self._poses.append((taken_ns, T_odom_sensor))

    def reaches(self, stamp_ns: int) -> bool:
        """Whether the track tells where the body was until then."""
        return bool(self._poses) and self._poses[-1][0] >= stamp_ns

    def twist(self, before_ns: int, stamp_ns: int) -> Float[np.ndarray, " 6"]:
        """The vehicle's mean twist (6,) between two times; NaN where it is not known."""
        kept = []  # back to the last one before both
        for one in reversed(self._poses):
            kept.append(one)
            if one[0] <= before_ns:
                break
        stamps_ns = np.array([one[0] for one in reversed(kept)], np.int64)
        poses = np.array([one[1] for one in reversed(kept)]).reshape(-1, 7)
        track = OdometryTrack(stamps_ns, poses, self._T_vehicle_sensor)
        return track.twists(np.array([before_ns, stamp_ns]))[1]


def _logarithms(T: Float[np.ndarray, "K 4 4"]) -> Float[np.ndarray, "K 6"]:
    """Twists (K, 6) for a unit of time. Source: Barfoot (2017), Eqs. 7.35 and 7.37."""
    turn = Rotation.from_matrix(T[:, :3, :3]).as_rotvec()
    half = np.linalg.norm(turn, axis=1) / 2
    small = half < 1e-4
    safe = np.where(small, 1, half)
    # (1 - half cot(half)) / (2 half)^2, which tends to 1/12
    factor = np.where(small, 1 / 12, (1 - safe / np.tan(safe)) / (4 * safe**2))
    way = T[:, :3, 3]
    across = np.cross(turn, way)
    way = way - across / 2 + factor[:, None] * np.cross(turn, across)
    return np.concatenate([way, turn], axis=1)


# --- a delay between odometry and cameras, from how the body turns ---

# Of poses that markers show at two times, and the odometry's, the turns between are the same. Where
# its stamps are off, those that fit best are those of other times. A hand turns by degrees within a
# tenth of a second, and markers show turns to a degree, so that a minute tells some hundredths of a
# second.
_MOST_S = 1.0  # the search goes so far to either side
_STEP_S = 0.02
_APART_S = (0.1, 3.0)  # between the two times of a turn
_MOST_TURNS = 2000
_LEAST_TURNS = 30
_CLEARLY = 0.7  # misfit of the best delay against that of none, above which none is reported


@dataclass(frozen=True)
class OdometryDelay:
    """By how much an odometry's stamps are off.

    Attributes:
        delay_s: its poses were taken so long before their stamps, on the cameras' clock.
        misfit_rad: median difference of a turn with that delay, and without any.
    """

    delay_s: float
    misfit_rad: tuple[float, float]

    def __str__(self) -> str:
        with_it, without = np.rad2deg(self.misfit_rad)
        return (
            f"the odometry's stamps do not fit the cameras': with a delay of {self.delay_s:.2f} s "
            f"its turns are {with_it:.1f} deg off, without {without:.1f} deg"
        )


def odometry_delay(
    track: OdometryTrack,
    stamps_ns: Int[np.ndarray, " F"],
    T_world_vehicle: Float[np.ndarray, "F 7"],
    seen: Bool[np.ndarray, " F"],
) -> OdometryDelay | None:
    """The delay of an odometry; None where its stamps fit, or too little turns to tell.

    Source: Furgale, Rehder, Siegwart (2013), "Unified temporal and spatial calibration for
    multi-sensor systems"; the search over whole delays as in Mair, Fleps, Suppa, Burschka (2011),
    "Spatio-temporal initialization for IMU to camera registration".

    Args:
        T_world_vehicle: by markers.
        seen: where these tell anything.
    """
    rows = np.flatnonzero(seen)
    first, second = _pairs(stamps_ns[rows] / 1e9)
    first, second = rows[first], rows[second]
    R_world_vehicle = Rotation.from_quat(np.roll(T_world_vehicle[:, :4], -1, axis=1))
    turns = R_world_vehicle[first].inv() * R_world_vehicle[second]

    def misfit_rad(delay_s: float) -> float:
        known, R = track.rotations(stamps_ns + round(delay_s * 1e9))
        both = known[first] & known[second]
        if np.sum(both) < _LEAST_TURNS:
            return np.inf
        by_odometry = R[first[both]].inv() * R[second[both]]
        return float(np.median((turns[both].inv() * by_odometry).magnitude()))

    if len(first) < _LEAST_TURNS:
        return None
    delays_s = np.arange(-round(_MOST_S / _STEP_S), round(_MOST_S / _STEP_S) + 1) * _STEP_S
    misfits = np.array([misfit_rad(delay_s) for delay_s in delays_s])
    best, none = int(np.argmin(misfits)), misfits[len(misfits) // 2]
    if not misfits[best] < _CLEARLY * none:
        return None
    return OdometryDelay(float(delays_s[best]), (float(misfits[best]), float(none)))


def _pairs(times_s: Float[np.ndarray, " F"]) -> tuple[np.ndarray, np.ndarray]:
    """Indices of times that are as far apart as is looked at, `_MOST_TURNS` at most."""
    begin, end = (np.searchsorted(times_s, times_s + apart_s) for apart_s in _APART_S)
    first = np.repeat(np.arange(len(times_s)), end - begin)
    second = np.arange(len(first)) - np.repeat(np.cumsum(end - begin) - end, end - begin)
    picks = np.linspace(0, len(first) - 1, min(len(first), _MOST_TURNS)).astype(int)
    return first[picks], second[picks]
