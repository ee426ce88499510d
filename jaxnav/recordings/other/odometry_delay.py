"""Find a delay between odometry and cameras from how the body turns.

Of poses that markers show at two times, and the odometry's, the turns between are the same. Where
its stamps are off, those that fit best are those of other times. A hand turns by degrees within a
tenth of a second, and markers show turns to a degree, so that a minute tells some hundredths of a
second.

Source: Furgale, Rehder, Siegwart (2013), "Unified temporal and spatial calibration for multi-sensor
systems"; the search over whole delays as in Mair, Fleps, Suppa, Burschka (2011), "Spatio-temporal
initialization for IMU to camera registration".
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.spatial.transform import Rotation

from jaxnav.recordings.ros.odometry_track import OdometryTrack

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
