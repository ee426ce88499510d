"""The equations of the paper, written out one by one in plain NumPy loops.

Source: Liu, Schofield, Shan (2023). Frames and units as in jaxnav; matrices are 4x4.
"""

import numpy as np


def project(K, lens, k, point_camera):
    """Pixel of one point (Eq. 1), lenses as OpenCV documents them."""
    x, y, z = (float(value) for value in point_camera)
    if lens == "equidistant":
        r = np.hypot(x, y)
        theta = np.arctan2(r, z)
        bent = theta * (1 + k[0] * theta**2 + k[1] * theta**4 + k[2] * theta**6 + k[3] * theta**8)
        u, v = (x * bent / r, y * bent / r) if r > 0 else (0.0, 0.0)
    else:
        u, v = x / z, y / z
        if lens == "radtan":
            k1, k2, p1, p2, k3 = k[:5]
            r2 = u * u + v * v
            radial = 1 + k1 * r2 + k2 * r2**2 + k3 * r2**3
            u, v = (
                u * radial + 2 * p1 * u * v + p2 * (r2 + 2 * u * u),
                v * radial + p1 * (r2 + 2 * v * v) + 2 * p2 * u * v,
            )
    return np.array([K[0, 0] * u + K[0, 2], K[1, 1] * v + K[1, 2]])


def e1(cameras, Ts_camera_vehicle, corners_world, corners_px, visible, T_vehicle_world):
    """Eq. 3: over cameras j and corners i, |projection - observation|^2, pixel^2.

    Args:
        cameras: a list of (K, lens, coefficients).
        corners_world: (M, 4, 3); corners_px (C, M, 4, 2); visible (C, M).
    """
    total = 0.0
    for j, (K, lens, k) in enumerate(cameras):
        for m in range(len(corners_world)):
            if not visible[j][m]:
                continue
            for i in range(4):
                p_world = np.append(corners_world[m][i], 1.0)
                p_camera = Ts_camera_vehicle[j] @ T_vehicle_world @ p_world
                difference = project(K, lens, k, p_camera[:3]) - corners_px[j][m][i]
                total += difference[0] ** 2 + difference[1] ** 2
    return total


def e2(corners_world, in_view, T_vehicle_world, T_vehicle_world_prior):
    """Eq. 14: |T_vw p_i - T_w p_i|^2 over the corners of the markers in view, m^2."""
    total = 0.0
    for m in range(len(corners_world)):
        if not in_view[m]:
            continue
        for i in range(4):
            p_world = np.append(corners_world[m][i], 1.0)
            total += float(
                np.sum((T_vehicle_world @ p_world - T_vehicle_world_prior @ p_world) ** 2)
            )
    return total


def velocity(speed_mps, steering_rad, psi_rad, wheelbase_m):
    """Eqs. 4-7: (v_x, v_y, psi_dot)."""
    beta = np.arctan(0.5 * np.tan(steering_rad))
    if np.tan(steering_rad) == 0:
        psi_dot = 0.0
    else:
        turning_radius = wheelbase_m / (np.cos(beta) * np.tan(steering_rad))
        psi_dot = speed_mps / turning_radius
    return np.array(
        [speed_mps * np.cos(beta + psi_rad), speed_mps * np.sin(beta + psi_rad), psi_dot]
    )


def drive(pose, speed_mps, steering_rad, duration_s, wheelbase_m, steps=2000):
    """Eqs. 4-7 integrated in tiny midpoint steps; every pose on the way, (steps + 1, 3)."""
    poses = [np.asarray(pose, float)]
    h = duration_s / steps
    for _ in range(steps):
        slope = velocity(speed_mps, steering_rad, poses[-1][2], wheelbase_m)
        middle = poses[-1] + h / 2 * slope
        poses.append(poses[-1] + h * velocity(speed_mps, steering_rad, middle[2], wheelbase_m))
    return np.array(poses)


def steering(pose, waypoint_m, steering_measured_rad, wheelbase_m):
    """Eqs. 4, 17, 18, the arctan of a ratio read as atan2: (angle, L_d, alpha).

    See docs/design.md, Steering and throttle.
    """
    beta = np.arctan(0.5 * np.tan(steering_measured_rad))
    dx, dy = waypoint_m[0] - pose[0], waypoint_m[1] - pose[1]
    distance = np.sqrt(dx**2 + dy**2)
    alpha = np.arctan2(dy, dx) - pose[2] - beta
    alpha = np.arctan2(np.sin(alpha), np.cos(alpha))
    return (
        np.arctan(2 * wheelbase_m * np.sin(alpha) / (distance * np.cos(beta))),
        distance,
        alpha,
    )
