"""Poses, twist and covariances of an outcome in the frame of the base, as ROS has them.

A covariance of ROS is over x, y, z and rotations about the fixed axes x, y, z of the frame that the
pose is given in; a twist and its covariance are in the axes of the base.
"""

import numpy as np
from jaxtyping import Float

from jaxnav.core.filter.bank import Bank
from jaxnav.core.filter.planar import planar_poses
from jaxnav.core.models.origin import Origin, poses_in_world
from jaxnav.drive.pilot import Outcome
from jaxnav.files.poses import compose, matrix
from jaxnav.recordings.learnt import heaviest_slot

PLANAR = np.array([0, 1, 5])  # x, y and the rotation about z among the six
_FLOOR_VARIANCE = 1e-6  # of z, roll and pitch of a car on its floor, (1 mm)^2 and (1 mrad)^2


def base_pose(outcome: Outcome, base_x_m: float) -> Float[np.ndarray, " 7"]:
    """T_map_base (7,) wxyz_xyz.

    Args:
        base_x_m: where the base is on the vehicle, forward of the middle between its axles.
    """
    return _base_of(np.asarray(outcome.T_world_vehicle, float), base_x_m)


def base_pose_covariance(
    outcome: Outcome, base_x_m: float
) -> tuple[Float[np.ndarray, " 7"], Float[np.ndarray, "6 6"]]:
    """`base_pose`, and its covariance in the axes of the map."""
    pose = base_pose(outcome, base_x_m)
    if moves_freely(outcome.belief.bank):
        covariance = np.asarray(outcome.output.covariance, float)[:6, :6]  # in the body's axes
        return pose, _at_base(pose, _turned(covariance, matrix(pose)[:3, :3]), base_x_m)
    return pose, _at_base(pose, _among_six(outcome.output.pose_covariance), base_x_m)


def base_twist(
    outcome: Outcome, base_x_m: float
) -> tuple[Float[np.ndarray, " 6"], Float[np.ndarray, "6 6"]]:
    """The twist (6,) of the base in its own axes, m/s and rad/s, and its covariance."""
    bank, output = outcome.belief.bank, outcome.output
    if moves_freely(bank):
        twist = np.asarray(bank.mean, float)[heaviest_slot(bank), 7:13]
        covariance = np.asarray(output.covariance, float)[6:12, 6:12]
    else:
        turn = matrix(np.asarray(outcome.T_world_vehicle, float))[:3, :3].T
        velocity = np.zeros(6)  # in the axes of the world
        velocity[PLANAR] = np.asarray(output.velocity, float)
        twist = np.concatenate([turn @ velocity[:3], turn @ velocity[3:]])
        covariance = _turned(_among_six(output.velocity_covariance), turn)
    J = np.eye(6)
    J[:3, 3:] = -_cross(np.array([base_x_m, 0.0, 0.0]))
    return J @ twist, J @ covariance @ J.T


def base_hypotheses(
    outcome: Outcome, base_x_m: float
) -> tuple[Float[np.ndarray, "K 7"], Float[np.ndarray, "K 6 6"], Float[np.ndarray, " K"]]:
    """The hypotheses that are alive, the heaviest first: poses T_map_base, their covariances in
    the axes of the map, and weights whose sum is 1."""
    bank = outcome.belief.bank
    alive = np.flatnonzero(np.asarray(bank.initialised))
    log_weight = np.asarray(bank.log_weight, float)[alive]
    order = np.argsort(-log_weight, kind="stable")
    weight = np.exp(log_weight[order] - np.max(log_weight, initial=-np.inf))
    poses, covariances = [], []
    for row in alive[order]:
        pose, covariance = _vehicle_pose(bank, int(row), outcome.origin_m)
        poses.append(_base_of(pose, base_x_m))
        covariances.append(_at_base(poses[-1], covariance, base_x_m))
    return (
        np.array(poses).reshape(-1, 7),
        np.array(covariances).reshape(-1, 6, 6),
        weight / max(float(np.sum(weight)), 1e-300),
    )


def moves_freely(bank: Bank) -> bool:
    """Whether it is of a body free in six directions: a quaternion has a number more."""
    return bank.mean.shape[1] > bank.covariance.shape[1]


def _vehicle_pose(bank: Bank, row: int, origin_m: Origin) -> tuple[np.ndarray, np.ndarray]:
    """A hypothesis's pose of the vehicle in the world, and its covariance in the world's axes."""
    if moves_freely(bank):
        mean, P = np.asarray(bank.mean, float)[row], np.asarray(bank.covariance, float)[row]
        pose = np.asarray(poses_in_world(mean[:7], origin_m), float)
        return pose, _turned(P[:6, :6], matrix(pose)[:3, :3])
    planar, covariance = planar_poses(bank)
    x_m, y_m, psi_rad = np.asarray(planar, float)[row]
    half = psi_rad / 2
    pose = np.array([np.cos(half), 0, 0, np.sin(half), x_m, y_m, 0.0])
    return np.asarray(poses_in_world(pose, origin_m), float), _among_six(covariance[row])


def _base_of(T_map_vehicle: np.ndarray, base_x_m: float) -> np.ndarray:
    return compose(T_map_vehicle, np.array([1.0, 0, 0, 0, base_x_m, 0, 0]))


def _at_base(T_map_base: np.ndarray, covariance: np.ndarray, base_x_m: float) -> np.ndarray:
    """The covariance (6, 6) of the base's pose from that of the vehicle's."""
    J = np.eye(6)
    J[:3, 3:] = -_cross(matrix(T_map_base)[:3, 0] * base_x_m)
    return np.asarray(J @ covariance @ J.T)


def _among_six(covariance: object) -> np.ndarray:
    six = np.diag(np.where(np.isin(np.arange(6), PLANAR), 0.0, _FLOOR_VARIANCE))
    six[np.ix_(PLANAR, PLANAR)] = np.asarray(covariance, float)
    return six


def _turned(covariance: np.ndarray, R: np.ndarray) -> np.ndarray:
    """A covariance of two vectors in other axes."""
    turn = np.kron(np.eye(2), R)
    return np.asarray(turn @ covariance @ turn.T)


def _cross(v: np.ndarray) -> np.ndarray:
    x, y, z = v
    return np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
