"""Placement of the vehicle frame on a rig whose cameras' relative poses are calibrated.

Cameras alone don't determine it. The frame is fitted to camera poses measured by hand, or found
from driving; a rig calibrated about one camera is moved there with its uncertainty.

On level ground the axis about which the rig turns is the vehicle's z, and the floor gives the
height. On a straight line the vehicle heads where it goes. In a curve the middle of the rear axle
does not slide sideways, and the wheels' speed is that of the reference point alone.
"""

from dataclasses import dataclass, replace

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from jaxnav.calibrate.rig.calibrate import RigCalibration
from jaxnav.calibrate.rig.views import inverted
from jaxnav.core.models.geometry import wrap_angle
from jaxnav.core.models.vehicle import advance_bicycle
from jaxnav.errors import BadInput
from jaxnav.files.poses import transform

# Sigmas of poses measured by tape and eye.
_PLACE_SIGMA_M, _PLACE_SIGMA_RAD = 0.01, np.deg2rad(3)
_LEAST_S, _MOST_S = 0.3, 1.0  # between the frames of a pair
_LEAST_PAIRS = 20
_TILT_RAD = np.deg2rad(5)  # beyond this the ground is not level, or the world's z not up
_FAR = 2.0  # sigmas
_REWEIGHTED = 10  # times
_LEAST_SPREAD = 1e-5  # m and rad: nothing is known better than this
# The largest sigmas that are accepted.
_SIGMA_M, _SIGMA_RAD = 0.02, np.deg2rad(1)
_NAMES = ("x", "y", "heading", "speed scale", "steering offset", "steering gain")
# On a straight line the gain could be anything: it stays within a factor of 20, so does the scale.
_MOST = np.array([np.inf, np.inf, np.inf, 3.0, 1.0, 3.0])


@dataclass(frozen=True)
class DrivenFrame:
    """The vehicle frame found from driving, with its uncertainty."""

    # the level frame, z up, on the ground, in the rig's calibrated frame
    T_rig_level: Float[np.ndarray, "4 4"]
    T_level_vehicle: Float[np.ndarray, "4 4"]  # a shift and a turn on the ground
    # of the twist xi in T_rig_level * T_level_vehicle * exp(xi), from the drive's uncertainty
    # alone; for the ground's see `level_follows`
    covariance: Float[np.ndarray, "6 6"]


def moved_to_places(
    calibration: RigCalibration, given: Float[np.ndarray, "C 4 4"]
) -> RigCalibration:
    """Move the calibration to the vehicle frame in which the cameras fit their given poses best.

    Args:
        given: (C, 4, 4) T_vehicle_camera as measured by hand; those of cameras that were not
            calibrated don't count.
    """
    cameras = np.flatnonzero(calibration.calibrated)
    Ts_vehicle_camera, wanted = calibration.Ts_vehicle_camera[cameras], given[cameras]
    weight = np.repeat([1 / _PLACE_SIGMA_M, 1 / _PLACE_SIGMA_RAD], 3)
    start = wanted[0] @ inverted(Ts_vehicle_camera[0])

    def misfit(x: np.ndarray) -> np.ndarray:
        apart = inverted(wanted) @ (_rigid(x) @ start) @ Ts_vehicle_camera
        turned = Rotation.from_matrix(apart[:, :3, :3]).as_rotvec()
        return np.ravel(np.concatenate([apart[:, :3, 3], turned], axis=1) * weight)

    T_tied_vehicle = _rigid(least_squares(misfit, np.zeros(6)).x) @ start
    # The fit takes up the errors that all cameras have in common.
    A = np.concatenate([adjoint(T) for T in inverted(T_tied_vehicle @ Ts_vehicle_camera)])
    W = np.tile(weight**2, len(cameras))
    keep = np.eye(len(A)) - A @ np.linalg.solve((A.T * W) @ A, A.T * W)
    G = np.eye(len(calibration.covariance))
    rows = (6 * cameras[:, None] + np.arange(6)).ravel()
    G[np.ix_(rows, rows)] = keep
    return _moved(calibration, T_tied_vehicle, G @ calibration.covariance @ G.T)


def moved_to_driven(calibration: RigCalibration, driven: DrivenFrame) -> RigCalibration:
    """Move the calibration to the frame found from driving; add the drive's and ground's errors."""
    cameras = np.flatnonzero(calibration.calibrated)
    T_tied_vehicle = inverted(driven.T_rig_level @ driven.T_level_vehicle)
    Ts_tied_camera = T_tied_vehicle @ calibration.Ts_vehicle_camera[cameras]
    A = np.concatenate([adjoint(T) for T in inverted(Ts_tied_camera)])
    follows = adjoint(inverted(driven.T_level_vehicle)) @ level_follows(
        calibration.Ts_world_vehicle, calibration.frames_follow
    )
    rows = (6 * cameras[:, None] + np.arange(6)).ravel()
    G = np.eye(len(calibration.covariance))
    G[rows] -= A @ follows
    covariance = G @ calibration.covariance @ G.T
    covariance[np.ix_(rows, rows)] += A @ driven.covariance @ A.T
    return _moved(calibration, T_tied_vehicle, covariance)


def _moved(
    calibration: RigCalibration, T_tied_vehicle: np.ndarray, covariance: np.ndarray
) -> RigCalibration:
    """Express a calibration in another vehicle frame; cameras that were not calibrated stay."""
    Ts = np.where(
        calibration.calibrated[:, None, None],
        T_tied_vehicle @ calibration.Ts_vehicle_camera,
        calibration.Ts_vehicle_camera,
    )
    return replace(
        calibration,
        Ts_vehicle_camera=Ts,
        Ts_world_vehicle=calibration.Ts_world_vehicle @ inverted(T_tied_vehicle),
        covariance=covariance,
    )


def adjoint(T: Float[np.ndarray, "4 4"]) -> Float[np.ndarray, "6 6"]:
    """(6, 6) A in T exp(xi) = exp(A xi) T, twists ordered (translation, rotation)."""
    R, t = T[:3, :3], T[:3, 3]
    cross = np.array([[0, -t[2], t[1]], [t[2], 0, -t[0]], [-t[1], t[0], 0]])
    A = np.zeros((6, 6))
    A[:3, :3] = A[3:, 3:] = R
    A[:3, 3:] = cross @ R
    return A


def _rigid(x: np.ndarray) -> np.ndarray:
    return transform(Rotation.from_rotvec(x[3:]).as_matrix(), x[:3])


def driven_frame(
    stamps_s: Float[np.ndarray, " F"],
    Ts_world_rig: Float[np.ndarray, "F 4 4"],
    odometry_s: Float[np.ndarray, " O"],
    speed_mps: Float[np.ndarray, " O"],
    steering_rad: Float[np.ndarray, " O"],
    wheelbase_m: float,
) -> DrivenFrame:
    """Find the vehicle frame from the rig's poses and the odometry of a drive.

    Args:
        stamps_s: (F,) of the frames, by the odometry's clock.
        Ts_world_rig: (F, 4, 4), in a world with z up and the ground at z = 0.
        odometry_s, speed_mps, steering_rad: (O,), increasing in time.

    Raises:
        BadInput: the drive is too short, or does not determine the frame.
    """
    read = np.isfinite(speed_mps) & np.isfinite(steering_rad)
    odometry_s, speed_mps, steering_rad = odometry_s[read], speed_mps[read], steering_rad[read]
    T_rig_level, weight = _level(Ts_world_rig)
    flat = Ts_world_rig @ T_rig_level
    planar = np.stack(
        [flat[:, 0, 3], flat[:, 1, 3], np.arctan2(flat[:, 1, 0], flat[:, 0, 0])], axis=1
    )
    first, last = _pairs(stamps_s, odometry_s)
    if len(first) < _LEAST_PAIRS:
        problem = (
            f"{len(first)} pairs of frames {_LEAST_S} to {_MOST_S} s apart have odometry between "
            f"them, at least {_LEAST_PAIRS} are needed: drive for a minute with markers in view"
        )
        raise BadInput("--vehicle-frame drive", problem)
    ends_s = np.stack([stamps_s[first], stamps_s[last]], axis=1)
    pieces = _pieces(ends_s, odometry_s, speed_mps, steering_rad)
    x, covariance = _fitted(*map(jnp.asarray, (planar[first], planar[last], pieces, wheelbase_m)))
    sigma = np.sqrt(np.diag(covariance))
    limits = np.array([_SIGMA_M, _SIGMA_M, _SIGMA_RAD])
    if not np.all(sigma[:3] < limits):
        which = _NAMES[int(np.argmax(np.nan_to_num(sigma[:3] / limits, nan=np.inf)))]
        problem = f"this drive does not tell the vehicle's {which}: drive circles both ways, slowly"
        raise BadInput("--vehicle-frame drive", problem)
    turn = transform(Rotation.from_rotvec([0, 0, x[2]]).as_matrix(), [*x[:2], 0])
    # The shift was found in the level frame; a twist's is in the vehicle's own.
    R = turn[:2, :2].T
    to_twist = np.zeros((6, 3))
    to_twist[:2, :2], to_twist[5, 2] = R, 1
    whole = to_twist @ covariance[:3, :3] @ to_twist.T
    # Frames next to each other err alike: their mean counts no more frames than there are pairs.
    alone = max(float(np.sum(weight**2)), 1 / len(first))
    whole[2, 2] = alone * (weight @ flat[:, 2, 3] ** 2)
    whole[3, 3] = whole[4, 4] = alone * (weight @ np.mean(flat[:, 2, :2] ** 2, axis=1))
    return DrivenFrame(T_rig_level, turn, whole)


def level_follows(
    Ts_world_rig: Float[np.ndarray, "F 4 4"], frames_follow: Float[np.ndarray, "F 6 R"]
) -> Float[np.ndarray, "6 R"]:
    """(6, R): derivative of the twist of T_rig_level by the unknowns that all frames share.

    The known markers define the ground. Their poses relative to the others, and so to where the rig
    drove, are known no better than they were seen; such errors tilt and lift all frames alike.
    `frames_follow` has the derivatives of the frames' twists.
    """
    T_rig_level, weight = _level(Ts_world_rig)
    z, height_m = T_rig_level[:3, 2], float(weight @ Ts_world_rig[:, 2, 3])
    up = Ts_world_rig[:, 2, :3]
    shift, turn = frames_follow[:, :3], frames_follow[:, 3:]
    lift = np.einsum("f,fi,fir->r", weight, up, shift)
    tilt = -np.einsum("f,fir->ir", weight, np.cross(turn, up[:, :, None], axis=1))  # of z
    moved = -tilt * height_m - np.outer(z, lift)
    turned = np.cross(z[:, None], tilt, axis=0)
    R_level_rig = T_rig_level[:3, :3].T
    return np.concatenate([R_level_rig @ moved, R_level_rig @ turned])


def _level(Ts_world_rig: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """T_rig_level, z up and its origin on the ground below the rig's; and the weight of each frame
    in it, (F,), with sum 1: a frame that saw little may be far off."""
    up, height_m = Ts_world_rig[:, 2, :3], Ts_world_rig[:, 2, 3]
    seen = np.column_stack([height_m, up])
    weight = np.full(len(seen), 1 / len(seen))
    for _ in range(_REWEIGHTED):
        off = seen - weight @ seen
        scale = np.maximum(1.4826 * np.median(np.abs(off), axis=0), _LEAST_SPREAD)
        weight = 1 / (1 + np.sum((off / scale) ** 2, axis=1) / len(scale)) ** 2
        weight /= weight.sum()
    height, *z = weight @ seen
    z = np.array(z) / np.linalg.norm(z)
    tilt_rad = np.sqrt(np.sum(np.median((up - z) ** 2, axis=0)))
    if tilt_rad > _TILT_RAD:
        problem = (
            f"the rig tilts by {np.rad2deg(tilt_rad):.0f} degrees: drive on level ground, and give "
            "the known markers in a world whose z is up and 0 on the ground"
        )
        raise BadInput("--vehicle-frame drive", problem)
    aside = np.eye(3)[np.argmin(np.abs(z))]
    x = np.cross(aside, z) / np.linalg.norm(np.cross(aside, z))
    return transform(np.stack([x, np.cross(z, x), z], axis=1), -z * height), weight


def _pairs(stamps_s: np.ndarray, odometry_s: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Indices of first and last frames of pairs, far enough apart in time to move, not too far."""
    pairs, begin = [], 0
    for index in range(1, len(stamps_s)):
        apart = stamps_s[index] - stamps_s[begin]
        if _LEAST_S <= apart <= _MOST_S:
            pairs.append((begin, index))
        if apart >= _LEAST_S:
            begin = index
    first, last = np.array(pairs, int).reshape(-1, 2).T
    known = (odometry_s[0] <= stamps_s[first]) & (stamps_s[last] <= odometry_s[-1] + 0.1)
    return first[known], last[known]


def _pieces(
    ends_s: np.ndarray, odometry_s: np.ndarray, speed_mps: np.ndarray, steering_rad: np.ndarray
) -> Float[np.ndarray, "P J 3"]:
    """Speed, steering and duration of the pieces between readings that make up each pair."""
    rows = []
    for a, b in ends_s:
        cuts = np.concatenate([[a], odometry_s[(odometry_s > a) & (odometry_s < b)], [b]])
        at = np.clip(np.searchsorted(odometry_s, cuts[:-1], side="right") - 1, 0, None)
        rows.append(np.stack([speed_mps[at], steering_rad[at], np.diff(cuts)], axis=1))
    longest = max(len(row) for row in rows)
    padded = [np.pad(row, ((0, longest - len(row)), (0, 0))) for row in rows]
    return np.stack(padded)


def _fitted(*pairs: Array) -> tuple[np.ndarray, np.ndarray]:
    """Fit (x, y, heading, log speed scale, steering offset, log steering gain); with covariance.

    The odometry's errors are found as well: in a curve, a relative error of the gain moves the
    frame forward by that part of half the wheelbase.
    """
    fits = []
    for heading in np.arange(4) * np.pi / 2:
        x, sigma = np.array([0, 0, heading, 0, 0, 0]), np.full(3, 0.01)
        for _ in range(3):
            x = least_squares(
                lambda *at: np.asarray(_misfits(*at)[0]),
                x,
                lambda *at: np.asarray(_misfits(*at)[1]),
                bounds=(-_MOST, _MOST),
                x_scale="jac",
                ftol=1e-12,
                xtol=1e-12,
                gtol=1e-12,
                max_nfev=40,
                args=(sigma, *pairs),
            ).x
            J, apart = np.asarray(_misfits(x, sigma, *pairs)[1]), np.asarray(_apart(x, *pairs))
            sigma = np.maximum(1.4826 * np.median(np.abs(apart), axis=0), _LEAST_SPREAD)
        fits.append((np.sum(np.log(sigma)), x, np.linalg.pinv(J.T @ J)))
    _, x, covariance = min(fits, key=lambda fit: fit[0])
    return x, covariance


@jax.jit
def _misfits(x: Array, sigma: Array, *pairs: Array) -> tuple[Array, Array]:
    """Residuals (3 P,) of the pairs in sigmas, under Huber's loss, and their Jacobian (3 P, 6)."""

    def misfits(x: Array) -> tuple[Array, Array]:
        rows = (_apart(x, *pairs) / sigma[None]).ravel()
        # Wheels that slip pull, but no more the more they slip.
        length = jnp.abs(rows)
        far = jnp.sqrt(jnp.maximum(2 * _FAR * length - _FAR**2, _FAR**2))
        rows = jnp.where(length < _FAR, rows, jnp.sign(rows) * far)
        return rows, rows

    J, rows = jax.jacfwd(misfits, has_aux=True)(x)
    return rows, J


@jax.jit
def _apart(
    x: Array, firsts: Array, lasts: Array, pieces: Array, wheelbase_m: Array
) -> Float[Array, "P 3"]:
    """Vehicle's pose at the end of each pair minus that by odometry: along, across, turned.

    Args:
        firsts, lasts: (P, 3) level poses of the rig, x y psi.
        pieces: (P, J, 3) the odometry in between, see `_pieces`.
    """

    def of_vehicle(pose: Array) -> Array:
        c, s = jnp.cos(pose[2]), jnp.sin(pose[2])
        return pose + jnp.stack([c * x[0] - s * x[1], s * x[0] + c * x[1], x[2]])

    def along(pose: Array, piece: Array) -> tuple[Array, None]:
        speed, steering = piece[0] * jnp.exp(x[3]), piece[1] * jnp.exp(x[5]) + x[4]
        return advance_bicycle(pose, speed, steering, piece[2], wheelbase_m), None

    def one(first: Array, last: Array, pieces: Array) -> Array:
        predicted, _ = jax.lax.scan(along, of_vehicle(first), pieces)
        apart = of_vehicle(last) - predicted
        c, s = jnp.cos(predicted[2]), jnp.sin(predicted[2])
        return jnp.stack(
            [c * apart[0] + s * apart[1], c * apart[1] - s * apart[0], wrap_angle(apart[2])]
        )

    return jax.vmap(one)(firsts, lasts, pieces)
