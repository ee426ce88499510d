"""The paper's Kalman filter as a textbook writes it.

Source: Liu, Schofield, Shan (2023), Eqs. 8-11: explicit inverse, (I - K H) P, rows of a missing
measurement left out.
"""

import numpy as np

from tests.reference.paper import velocity


def wrap(angle_rad):
    """The same angle in [-pi, pi]."""
    return np.arctan2(np.sin(angle_rad), np.cos(angle_rad))


def predict(x, P, dt_s, density, odometry=None):
    """Eq. 9 with the noise of a white acceleration.

    `odometry` is (speed_mps, steering_rad, wheelbase_m): the velocity may have become that at any
    instant of the interval, u before its end, and the pose has then moved by the difference times
    u. The mean of the squares over u by Gauss's rule of two points.
    """
    A = np.eye(6)
    Q = np.zeros((6, 6))
    for i in range(3):
        A[i, i + 3] = dt_s
        Q[i, i] = density[i] * dt_s**3 / 3
        Q[i, i + 3] = Q[i + 3, i] = density[i] * dt_s**2 / 2
        Q[i + 3, i + 3] = density[i] * dt_s
    x = A @ x
    x[2] = wrap(x[2])
    P = A @ P @ A.T + Q
    if odometry is not None:
        speed_mps, steering_rad, wheelbase_m = odometry
        change = velocity(speed_mps, steering_rad, x[2], wheelbase_m) - x[3:]
        for point in (-1 / np.sqrt(3), 1 / np.sqrt(3)):
            u_s = dt_s / 2 * (1 + point)
            step = np.concatenate([change * u_s, change])
            P = P + np.outer(step, step) / 2
    return x, P


def update(x, P, pose, R_pose, speed_mps, steering_rad, wheelbase_m, odometry_sigma):
    """Eqs. 10 and 11; `pose` None: odometry alone. Returns x, P and the NIS of the pose.

    The NIS is that of the pose once the odometry is known: by the chain rule of probability the
    NIS of all rows together, less that of the odometry's.

    The odometry predicts v (cos, sin)(psi + beta) - (v_x, v_y) = 0: a function of the state whose
    derivative with respect to psi stands in the heading's column of H.
    """
    v = velocity(speed_mps, steering_rad, x[2], wheelbase_m)
    z_minus_h = list(v - x[3:])
    H = np.zeros((3, 6))
    H[:, 3:] = np.eye(3)
    H[0, 2], H[1, 2] = v[1], -v[0]
    R = np.diag(np.asarray(odometry_sigma) ** 2)
    nis_odometry = z_minus_h @ np.linalg.inv(H @ P @ H.T + R) @ z_minus_h
    if pose is not None:
        innovation = np.asarray(pose) - x[:3]
        innovation[2] = wrap(innovation[2])
        z_minus_h = [*innovation, *z_minus_h]
        H = np.vstack([np.eye(3, 6), H])
        R = np.block([[R_pose, np.zeros((3, 3))], [np.zeros((3, 3)), R]])
    S_inverse = np.linalg.inv(H @ P @ H.T + R)
    K = P @ H.T @ S_inverse
    nis = z_minus_h @ S_inverse @ z_minus_h - nis_odometry
    x = x + K @ np.array(z_minus_h)
    x[2] = wrap(x[2])
    left = np.eye(6) - K @ H  # Joseph's form: as little rounding as possible
    return x, left @ P @ left.T + K @ R @ K.T, nis
