"""Placement of the vehicle frame on a rig whose cameras' relative poses are calibrated.

Cameras alone don't determine it. The frame is fitted to camera poses measured by hand, or found
from driving (`driven_frame`); a rig calibrated about one camera is moved there with its
uncertainty.
"""

from dataclasses import replace

import numpy as np
from jaxtyping import Float
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from jaxnav.calibrate.rig.calibrate import RigCalibration
from jaxnav.calibrate.rig.driven_frame import DrivenFrame, level_follows
from jaxnav.calibrate.rig.pose_arrays import inverted
from jaxnav.files.poses import transform

# Sigmas of poses measured by tape and eye.
_PLACE_SIGMA_M, _PLACE_SIGMA_RAD = 0.01, np.deg2rad(3)


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
    return moved(calibration, T_tied_vehicle, G @ calibration.covariance @ G.T)


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
    return moved(calibration, T_tied_vehicle, covariance)


def moved(
    calibration: RigCalibration,
    T_tied_vehicle: Float[np.ndarray, "4 4"],
    covariance: Float[np.ndarray, "R R"],
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


def moved_world(calibration: RigCalibration, move: Float[np.ndarray, "4 4"]) -> RigCalibration:
    """Express a calibration in another world frame; covariances stay, as twists are body-fixed.

    Args:
        move: (4, 4), pose of the old world in the new.
    """
    return replace(
        calibration,
        Ts_world_marker=move @ calibration.Ts_world_marker,
        Ts_world_vehicle=move @ calibration.Ts_world_vehicle,
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
