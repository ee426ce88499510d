"""What ROS is told of an estimate: its poses, twist and covariances in the frame of the base.

A covariance of ROS is over x, y, z and rotations about the fixed axes x, y, z of the frame that the
pose is given in; a twist and its covariance are in the axes of the base.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from jaxnav.core.filter.bank import Bank
from jaxnav.core.filter.planar import planar_poses
from jaxnav.core.models.origin import Origin, poses_in_world
from jaxnav.core.navigator import Output
from jaxnav.drive.flags import names
from jaxnav.drive.pilot import Outcome
from jaxnav.files.poses import compose, matrix

PLANAR = np.array([0, 1, 5])  # x, y and the rotation about z among the six
_FLOOR_VARIANCE = 1e-6  # of z, roll and pitch of a car on its floor, (1 mm)^2 and (1 mrad)^2


@dataclass(frozen=True)
class Hypotheses:
    """K hypotheses, the heaviest first.

    Attributes:
        T_map_base: (K, 7) wxyz_xyz.
        covariance: (K, 6, 6) in the axes of the map.
        weight: (K,) their sum is 1.
    """

    T_map_base: Float[np.ndarray, "K 7"]
    covariance: Float[np.ndarray, "K 6 6"]
    weight: Float[np.ndarray, " K"]


@dataclass(frozen=True)
class Report:
    """An estimate as ROS is told it.

    Attributes:
        now_ns: time of the pose, on the clock of the program.
        T_map_base: (7,) wxyz_xyz.
        covariance: (6, 6) in the axes of the map.
        twist: (6,) m/s and rad/s, in the axes of the base.
        health: in a word; empty where nobody drives or odometry is not used.
    """

    now_ns: int
    T_map_base: Float[np.ndarray, " 7"]
    covariance: Float[np.ndarray, "6 6"]
    twist: Float[np.ndarray, " 6"]
    twist_covariance: Float[np.ndarray, "6 6"]
    located: bool
    decided: bool
    accepted: bool
    flip_probability: float
    nis: float
    restarts: int
    health: str
    faults: list[str]
    rejects: list[str]
    bank: Bank
    origin_m: Origin
    base_x_m: float

    @property
    def is_finite(self) -> bool:
        """Whether all of it are numbers."""
        parts = self.T_map_base, self.covariance, self.twist, self.twist_covariance
        return all(bool(np.isfinite(part).all()) for part in parts)

    def hypotheses(self) -> Hypotheses:
        """The hypotheses that are alive."""
        alive = np.flatnonzero(np.asarray(self.bank.initialised))
        log_weight = np.asarray(self.bank.log_weight, float)[alive]
        order = np.argsort(-log_weight, kind="stable")
        weight = np.exp(log_weight[order] - np.max(log_weight, initial=-np.inf))
        rows = [_pose_of(self.bank, int(row), self.origin_m) for row in alive[order]]
        poses = [_base_of(pose, self.base_x_m) for pose, _ in rows]
        covariances = [
            _at_base(pose, covariance, self.base_x_m)
            for pose, (_, covariance) in zip(poses, rows, strict=True)
        ]
        return Hypotheses(
            np.array(poses).reshape(-1, 7),
            np.array(covariances).reshape(-1, 6, 6),
            weight / max(float(np.sum(weight)), 1e-300),
        )


def pose_of_drive(outcome: Outcome, base_x_m: float) -> Float[np.ndarray, " 7"]:
    """T_map_base (7,) of a pilot's outcome."""
    return _base_of(np.asarray(outcome.T_world_vehicle, float), base_x_m)


def report_of_drive(outcome: Outcome, base_x_m: float) -> Report:
    """The report of a pilot's outcome.

    Args:
        base_x_m: where the base is on the vehicle, forward of the middle between its axles.
    """
    output = outcome.output
    pose = pose_of_drive(outcome, base_x_m)
    covariance = _at_base(pose, _among_six(output.pose_covariance), base_x_m)
    turn = matrix(pose)[:3, :3].T  # a velocity is in the axes of the world
    velocity = np.zeros(6)
    velocity[PLANAR] = np.asarray(output.velocity, float)
    twist, twist_covariance = _in_base(
        np.concatenate([turn @ velocity[:3], turn @ velocity[3:]]),
        _turned(_among_six(output.velocity_covariance), turn),
        base_x_m,
    )
    return _report(
        output, outcome.belief.bank, outcome.now_ns, (pose, covariance), (twist, twist_covariance),
        outcome.origin_m, base_x_m, outcome.restarts, outcome.health.name,
        names(outcome.faults), names(outcome.rejects),
    )  # fmt: skip


def report_of_body(
    output: Output, bank: Bank, restarts: int, now_ns: int, origin_m: Origin
) -> Report:
    """The report of a rig that moves freely; its base is the rig's own frame."""
    best = int(np.argmax(np.where(bank.initialised, bank.log_weight, -np.inf)))
    covariance = np.asarray(output.covariance, float)  # in the axes of the body
    pose = np.asarray(poses_in_world(output.T_world_vehicle.wxyz_xyz, origin_m), float)
    at = pose, _turned(covariance[:6, :6], matrix(pose)[:3, :3])
    twist = np.asarray(bank.mean, float)[best, 7:13], covariance[6:12, 6:12]
    return _report(
        output, bank, now_ns, at, twist,
        origin_m, 0.0, restarts, "", [], [],
    )  # fmt: skip


def _report(
    output: Output,
    bank: Bank,
    now_ns: int,
    pose: tuple[np.ndarray, np.ndarray],
    twist: tuple[np.ndarray, np.ndarray],
    origin_m: Origin,
    base_x_m: float,
    restarts: int,
    health: str,
    faults: list[str],
    rejects: list[str],
) -> Report:
    return Report(
        now_ns, *pose, *twist, bool(output.located), bool(output.decided), bool(output.accepted),
        float(output.flip_probability), float(output.nis), restarts, health, faults, rejects,
        bank, origin_m, base_x_m,
    )  # fmt: skip


def _pose_of(bank: Bank, row: int, origin_m: Origin) -> tuple[np.ndarray, np.ndarray]:
    """A hypothesis's pose of the vehicle in the world, and its covariance in the world's axes."""
    mean, P = np.asarray(bank.mean, float)[row], np.asarray(bank.covariance, float)[row]
    if mean.shape[0] > P.shape[0]:  # free in six directions: a quaternion has a number more
        pose = np.asarray(poses_in_world(mean[:7], origin_m), float)
        return pose, _turned(P[:6, :6], matrix(pose)[:3, :3])
    planar, covariance = planar_poses(bank)
    x_m, y_m, psi_rad = np.asarray(planar, float)[row]
    half = psi_rad / 2
    pose = np.array([np.cos(half), 0, 0, np.sin(half), x_m, y_m, 0.0])
    return np.asarray(poses_in_world(pose, origin_m), float), _among_six(covariance[row])


def _base_of(T_map_vehicle: np.ndarray, base_x_m: float) -> np.ndarray:
    """T_map_base (7,) of the vehicle's pose (7,)."""
    return compose(T_map_vehicle, np.array([1.0, 0, 0, 0, base_x_m, 0, 0]))


def _at_base(T_map_base: np.ndarray, covariance: np.ndarray, base_x_m: float) -> np.ndarray:
    """The covariance (6, 6) of the base's pose from that of the vehicle's."""
    J = np.eye(6)
    J[:3, 3:] = -_cross(matrix(T_map_base)[:3, 0] * base_x_m)
    return np.asarray(J @ covariance @ J.T)


def _in_base(
    twist: np.ndarray, covariance: np.ndarray, base_x_m: float
) -> tuple[np.ndarray, np.ndarray]:
    """The twist of the base, in its own axes, from that of the vehicle."""
    J = np.eye(6)
    J[:3, 3:] = -_cross(np.array([base_x_m, 0.0, 0.0]))
    return J @ twist, J @ covariance @ J.T


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
