"""Implement the car's step with OpenCV and NumPy: the peer of `bench_step.py`.

Both poses of a marker by IPPE and two `solvePnPRefineLM`, the paper's rule and its Kalman filter;
or the same bank of hypotheses as `MultiHypothesis`, all of them at once in arrays: corners
minimised by Levenberg-Marquardt next to each prediction, weighed, pruned, merged. For a car, one
marker, one camera that sees it, equidistant lenses, and a filter that has started. It leaves out
what jaxnav does beside that (rejections that agree, restarts, many markers, other lenses, mixed
rigs, bad input), all in its favour.
"""

from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.special import erfc

from jaxnav.core.filter.hypotheses import MultiHypothesis
from jaxnav.core.models.markers import CORNER_SIGNS
from jaxnav.core.navigator import Navigator, State

Array = NDArray[np.float64]
_DUMMY_TILT = np.array([2, 3, 4])  # z, roll, pitch: what the filter does not follow


class Reading(NamedTuple):
    """One observation."""

    corners_px: Array  # (C, 4, 2)
    visible: NDArray[np.bool_]  # (C,)
    speed_mps: float
    steering_rad: float
    dt_s: float


class Memory(NamedTuple):
    """What is carried from step to step: K hypotheses, and the controller's state."""

    mean: Array  # (K, 6)
    covariance: Array  # (K, 6, 6)
    log_weight: Array
    alive: NDArray[np.bool_]
    waypoint: int
    integral_ms: float
    explored_s: float
    side: float


class Result(NamedTuple):
    """What a step says."""

    pose: Array
    steering_rad: float
    throttle: float
    decided: bool
    flip_probability: float
    selected: int


def memory(state: State) -> Memory:
    """A copy of jaxnav's state."""
    bank, control = state.belief.bank, state.control
    assert control is not None
    return Memory(
        *(np.asarray(leaf, float) for leaf in (bank.mean, bank.covariance, bank.log_weight)),
        np.asarray(bank.initialised),
        int(control.waypoint_index),
        float(control.integral_ms),
        float(control.explored_s),
        float(control.side),
    )


class NumpyStep:
    """The step of one navigator, with its parameters."""

    def __init__(self, navigator: Navigator):
        rig, markers = navigator.rig, navigator.markers
        self.selector, self.motion, self.controller = (
            navigator.selector, navigator.motion, navigator.controller,
        )  # fmt: skip
        self.focal_px = np.asarray(rig.cameras.focal_px, float)
        self.center_px = np.asarray(rig.cameras.center_px, float)
        self.lens = np.asarray(rig.cameras.distortion, float)[:, :4]
        T = np.asarray(rig.Ts_camera_vehicle.as_matrix(), float)
        self.R_camera_vehicle, self.t_camera_vehicle = T[:, :3, :3], T[:, :3, 3]
        self.K = [np.array([[f[0], 0, c[0]], [0, f[1], c[1]], [0, 0, 1]])
                  for f, c in zip(self.focal_px, self.center_px, strict=True)]  # fmt: skip
        T_world_marker = np.asarray(markers.Ts_world_marker.as_matrix(), float)[0]
        self.R_world_marker, self.marker_m = T_world_marker[:3, :3], T_world_marker[:3, 3]
        self.corners_world = np.asarray(markers.corners_world_m, float)[0]
        self.corners_marker = CORNER_SIGNS * float(markers.size_m[0]) / 2
        self.sigma_px = float(navigator.corner_sigma_px)
        motion, vehicle = self.motion, self.motion.vehicle
        self.density, self.vision_floor = (
            np.asarray(x, float) for x in (motion.acceleration_density, motion.vision_floor)
        )
        self.odometry_R = np.diag(np.asarray(motion.odometry_sigma, float) ** 2)
        self.wheelbase_m = float(vehicle.wheelbase_m)
        self.limits = (float(vehicle.steering_limit_rad), float(vehicle.throttle_limit))
        self.lag = (float(vehicle.speed_time_constant_s), float(vehicle.speed_per_throttle_mps))
        self.tilt = np.array([motion.height_sigma_m, motion.tilt_sigma_rad, motion.tilt_sigma_rad])
        self.waypoints = np.asarray(self.controller.waypoints_m, float)
        self.gains = tuple(
            float(x) for x in (
                self.controller.proportional_per_m, self.controller.integral_per_ms,
                self.controller.integral_limit_ms, self.controller.waypoint_radius_m,
            )
        )  # fmt: skip

    def __call__(self, state: Memory, obs: Reading) -> tuple[Memory, Result]:
        """One step."""
        mean, P = self._predict(state.mean, state.covariance, obs)
        state = state._replace(mean=mean, covariance=P)
        camera = int(np.argmax(obs.visible))
        if not obs.visible[camera]:
            best = int(np.argmax(np.where(state.alive, state.log_weight, -np.inf)))
            return self._steer(state, state.mean[best], True, 0.0, -1, obs)
        candidates = self._candidates(camera, obs.corners_px[camera])
        if isinstance(self.selector, MultiHypothesis):
            return self._bank(state, camera, candidates, obs)
        return self._paper(state, candidates, obs)

    # The image

    def _project(self, camera: int, points: Array) -> tuple[Array, Array]:
        """Pixels (..., 2) of points (..., 3) in the vehicle frame, and their derivative there."""
        R = self.R_camera_vehicle[camera]
        x, y, z = np.moveaxis(points @ R.T + self.t_camera_vehicle[camera], -1, 0)
        k1, k2, k3, k4 = self.lens[camera]
        r2 = np.maximum(x**2 + y**2, 1e-18)
        r, squared = np.sqrt(r2), r2 + z**2
        theta = np.arctan2(r, z)
        t2 = theta**2
        ratio = theta / r * (1 + t2 * (k1 + t2 * (k2 + t2 * (k3 + t2 * k4))))
        rise = 1 + t2 * (3 * k1 + t2 * (5 * k2 + t2 * (7 * k3 + t2 * 9 * k4)))
        rise = rise / squared
        bend = (z * rise - ratio) / r2
        slope = np.empty((*x.shape, 2, 3))
        slope[..., 0, 0], slope[..., 1, 1] = ratio + bend * x**2, ratio + bend * y**2
        slope[..., 0, 1] = slope[..., 1, 0] = bend * x * y
        slope[..., 0, 2], slope[..., 1, 2] = -x * rise, -y * rise
        focal = self.focal_px[camera]
        pixels = np.stack([x * ratio, y * ratio], -1) * focal + self.center_px[camera]
        return pixels, (slope * focal[:, None]) @ R

    def _candidates(
        self, camera: int, corners_px: Array
    ) -> list[tuple[Array, Array, float, Array]]:
        """(R, t of T_world_vehicle, e1, covariance (6, 6) in the vehicle's axes), best first."""
        undistorted = cv2.fisheye.undistortPoints(
            corners_px[:, None], self.K[camera], self.lens[camera]
        )
        eye, none = np.eye(3), np.zeros(4)
        _, turns, shifts, _ = cv2.solvePnPGeneric(
            self.corners_marker, undistorted, eye, none, flags=cv2.SOLVEPNP_IPPE_SQUARE
        )
        R_cv, t_cv = self.R_camera_vehicle[camera], self.t_camera_vehicle[camera]
        poses = []
        for turn, shift in zip(turns, shifts, strict=True):
            turn, shift = cv2.solvePnPRefineLM(
                self.corners_marker, undistorted, eye, none, turn, shift
            )
            R_camera_world = cv2.Rodrigues(turn)[0] @ self.R_world_marker.T
            t_camera_world = shift[:, 0] - R_camera_world @ self.marker_m
            R_vehicle_world = R_cv.T @ R_camera_world
            poses.append((R_vehicle_world, R_cv.T @ (t_camera_world - t_cv)))
        Rs, ts = (np.stack(part) for part in zip(*poses, strict=True))
        points = self.corners_world @ np.swapaxes(Rs, 1, 2) + ts[:, None]
        pixels, slope = self._project(camera, points)
        errors = np.sum((pixels - corners_px) ** 2, axis=(1, 2))
        J = np.concatenate([slope, np.cross(points[:, :, None], slope)], axis=-1).reshape(
            len(Rs), 8, 6
        )
        covariances = np.linalg.inv(np.swapaxes(J, 1, 2) @ J / self.sigma_px**2 + 1e-6 * np.eye(6))
        return [(Rs[i].T, -Rs[i].T @ ts[i], float(errors[i]), covariances[i])
                for i in np.argsort(errors)]  # fmt: skip

    # The filter

    def _predict(self, mean: Array, P: Array, obs: Reading) -> tuple[Array, Array]:
        dt = obs.dt_s
        A = np.eye(6) + dt * np.eye(6, k=3)
        D = np.diag(self.density)
        Q = np.block([[D * dt**3 / 3, D * dt**2 / 2], [D * dt**2 / 2, D * dt]])
        mean, P = mean @ A.T, A @ P @ A.T + Q
        beta = np.arctan(np.tan(obs.steering_rad) / 2)
        course = mean[:, 2] + beta
        rate = obs.speed_mps * np.cos(beta) * np.tan(obs.steering_rad) / self.wheelbase_m
        vx, vy = obs.speed_mps * np.cos(course), obs.speed_mps * np.sin(course)
        H = np.zeros((len(mean), 3, 6))
        H[:, :, 3:] = np.eye(3)
        H[:, 0, 2], H[:, 1, 2] = vy, -vx
        innovation = np.stack([vx, vy, np.full_like(vx, rate)], 1) - mean[:, 3:]
        # Speed and steering have changed at an unknown instant.
        moments = np.array([[dt**2 / 3, dt / 2], [dt / 2, 1.0]])
        P = P + np.stack([np.kron(moments, np.outer(d, d)) for d in innovation])
        return _updated(mean, P, innovation, H, self.odometry_R)

    def _paper(self, state: Memory, candidates: list[Any], obs: Reading) -> tuple[Memory, Result]:
        """The paper's rule, e1 + e2, and the update with the pose it chose."""
        prior = state.mean[0]
        predicted = self._in_vehicle(prior[None])[0]
        costs = [
            e1 + np.sum(((self.corners_world - t) @ R - predicted) ** 2) / 0.01**2
            for R, t, e1, _ in candidates
        ]
        selected = int(np.argmin(costs))
        R, t, _, covariance = candidates[selected]
        pose = np.array([t[0], t[1], np.arctan2(R[1, 0], R[0, 0])])
        to_planar = np.zeros((3, 6))
        to_planar[:2, :3] = R[:2]
        c, s = R[0, 0], R[1, 0]
        across = np.array([-s, c]) / (c**2 + s**2)
        to_planar[2, 4], to_planar[2, 5] = -across @ R[:2, 2], across @ R[:2, 1]
        noise = to_planar @ covariance @ to_planar.T + np.diag(self.vision_floor**2)
        innovation = pose - prior[:3]
        innovation[2] = _wrapped(innovation[2])
        P = state.covariance
        nis = innovation @ np.linalg.solve(P[0, :3, :3] + noise, innovation)
        if nis <= self.motion.gate_nis:
            mean, P = _updated(state.mean, P, innovation[None], np.eye(3, 6)[None], noise)
            state = state._replace(mean=mean, covariance=P)
        e1 = np.array([candidate[2] for candidate in candidates]) / self.sigma_px**2
        volume = np.array([np.linalg.slogdet(candidate[3])[1] for candidate in candidates])
        likelihood = np.exp(-(e1 - volume - np.min(e1 - volume)) / 2)
        flip = 1 - likelihood[selected] / np.sum(likelihood)
        return self._steer(state, state.mean[0], True, float(flip), selected, obs)

    # The bank

    def _in_vehicle(self, pose: Array) -> Array:
        """The marker's corners (K, 4, 3) seen from planar poses (K, >= 3)."""
        c, s = np.cos(pose[:, 2])[:, None], np.sin(pose[:, 2])[:, None]
        x = self.corners_world[None, :, 0] - pose[:, :1]
        y = self.corners_world[None, :, 1] - pose[:, 1:2]
        z = np.broadcast_to(self.corners_world[:, 2], x.shape)
        return np.stack([c * x + s * y, c * y - s * x, z], -1)

    def _bank(
        self, state: Memory, camera: int, candidates: list[Any], obs: Reading
    ) -> tuple[Memory, Result]:
        s = self.selector
        lanes = np.flatnonzero(state.alive)
        mean, P, log_weight = state.mean[lanes], state.covariance[lanes], state.log_weight[lanes]
        free_cost = min(candidate[2] for candidate in candidates) / self.sigma_px**2
        scale2 = max(free_cost / (2 + 3 * np.sqrt(4)), 1.0)
        sigma = self.sigma_px * np.sqrt(scale2)

        K = len(lanes)
        eye = np.eye(3)
        to_body = np.tile(np.eye(6), (K, 1, 1))
        to_body[:, :2, :2] = _turns(-mean[:, 2])
        P_body = to_body @ P @ np.swapaxes(to_body, 1, 2)
        root = np.linalg.cholesky(P_body[:, :3, :3])
        corners, target = self._in_vehicle(mean), obs.corners_px[camera]
        slope = self._project(camera, corners)[1] / sigma
        answers = np.concatenate([slope, np.cross(corners[:, :, None], slope)], -1)
        J_t = -answers.reshape(K, 8, 6)[:, :, _DUMMY_TILT] * self.tilt
        best_t = np.linalg.solve(
            np.swapaxes(J_t, 1, 2) @ J_t + eye, np.swapaxes(J_t, 1, 2)
        )  # (K, 3, 8)

        def linearised(u: Array) -> tuple[Array, Array]:
            xi = (root @ u[..., None])[..., 0]
            moved = _moved_back(xi, corners)
            pixels, slope = self._project(camera, moved)
            slope = slope / sigma
            answers = np.concatenate([slope, np.cross(moved[:, :, None], slope)], -1)
            J = -answers.reshape(K, 8, 6)[:, :, [0, 1, 5]] @ (_cayley_jacobian(xi) @ root)
            both = np.concatenate([J, ((pixels - target) / sigma).reshape(K, 8, 1)], -1)
            t = -best_t @ both
            both = np.concatenate([both + J_t @ t, t], 1)
            return both[..., 3], both[..., :3]

        u = _minimised(linearised, np.zeros((K, 3)), s.max_steps)
        r, J = linearised(u)
        Jt = np.swapaxes(J, 1, 2)
        information, gradient = Jt @ J, (Jt @ r[..., None])[..., 0]
        cost = np.sum(r**2, 1)
        log_evidence = -(cost + np.sum(u**2, 1)) / 2 - np.linalg.slogdet(information + eye)[1] / 2
        R = np.linalg.inv(information + 1e-7 * eye)
        u_alone = u - (R @ gradient[..., None])[..., 0]
        unspread = np.linalg.inv(root)
        floor2 = np.diag([s.floor_m**2, s.floor_m**2, s.floor_rad**2])
        S_inverse = np.linalg.inv(R + unspread @ floor2 @ np.swapaxes(unspread, 1, 2) + eye)
        u_fused = (S_inverse @ u_alone[..., None])[..., 0]
        nis = np.sum(u_alone * u_fused, 1)
        xi = (root @ u_fused[..., None])[..., 0]
        carry = _cayley_jacobian(xi)
        carry_root = carry @ root
        posterior = carry_root @ (eye - S_inverse) @ np.swapaxes(carry_root, 1, 2)

        inflation = min(max(np.min(nis) / (3 + 3 * np.sqrt(6)), 1.0), s.max_inflation)
        posterior = posterior * inflation
        log_evidence = log_evidence + nis * (1 - 1 / inflation) / 2
        bounded = np.maximum(log_evidence - np.max(log_evidence), s.outlier_log_evidence)
        # In the sigma that the misfit allows.
        if np.min(cost) - free_cost < s.gate:
            log_weight = log_weight + bounded
        log_weight = log_weight - np.logaddexp.reduce(log_weight)
        alive = log_weight > s.forget_log_weight

        # The regression of the velocity on the pose.
        gain = P_body[:, :, :3] @ np.linalg.inv(P_body[:, :3, :3])
        back = np.linalg.inv(carry)
        at_prior = back @ posterior @ np.swapaxes(back, 1, 2)
        carried = P_body + gain @ (at_prior - P_body[:, :3, :3]) @ np.swapaxes(gain, 1, 2)
        change = np.tile(np.eye(6), (K, 1, 1))
        turned = np.arctan(xi[:, 2] / 2) * 2
        psi = _wrapped(mean[:, 2] + turned)
        change[:, :3, :3] = carry
        to_world = np.tile(np.eye(6), (K, 1, 1))
        to_world[:, :2, :2] = _turns(psi)
        change = to_world @ change
        P_after = change @ carried @ np.swapaxes(change, 1, 2)
        half = xi[:, 2] / 2
        shift = np.stack([xi[:, 0] - half * xi[:, 1], xi[:, 1] + half * xi[:, 0]], 1)
        shift = shift / (1 + half**2)[:, None]
        after = mean.copy()
        after[:, :2] += (_turns(mean[:, 2]) @ shift[..., None])[..., 0]
        after[:, 2] = psi
        after[:, 3:] += (gain[:, 3:] @ xi[..., None])[..., 0]
        nis = np.maximum(nis, cost - free_cost)
        passes = nis <= self.motion.gate_nis * inflation
        mean = np.where(passes[:, None], after, mean)
        P = np.where(passes[:, None, None], P_after, P)
        sigmas = np.sqrt(np.where(passes, posterior[:, 2, 2], P_body[:, 2, 2]))

        best = int(np.argmax(log_weight))
        apart = np.abs(_wrapped(mean[:, 2] - mean[best, 2]))
        mass = np.where(alive, np.exp(log_weight), 0)
        far = float(np.sum(mass[apart > s.far_rad]))
        scale = np.sqrt(2) * np.maximum(sigmas, 1e-6)
        flip = (
            np.sum(mass * (erfc((s.far_rad - apart) / scale) + erfc((s.far_rad + apart) / scale)))
            / 2
        )
        decided = bool(far < s.decided_mass and sigmas[best] < s.decided_sigma_rad)
        pose = mean[best]
        c, sine = np.cos(pose[2]), np.sin(pose[2])
        R_best = np.array([[c, -sine, 0], [sine, c, 0], [0, 0, 1]])
        traces = [np.trace(candidate[0].T @ R_best) for candidate in candidates]
        selected = int(np.argmax(traces))

        mean, P, log_weight, alive = self._merged(mean, P, log_weight, alive)
        full = (
            state.mean.copy(),
            state.covariance.copy(),
            np.full(len(state.alive), s.forget_log_weight),
        )
        full[0][lanes], full[1][lanes], full[2][lanes] = mean, P, log_weight
        everywhere = np.zeros(len(state.alive), bool)
        everywhere[lanes] = alive
        state = state._replace(
            mean=full[0], covariance=full[1], log_weight=full[2], alive=everywhere
        )
        best = int(np.argmax(np.where(everywhere, state.log_weight, -np.inf)))
        return self._steer(state, state.mean[best], decided, float(flip), selected, obs)

    def _merged(
        self, mean: Array, P: Array, log_weight: Array, alive: NDArray[np.bool_]
    ) -> tuple[Array, Array, Array, NDArray[np.bool_]]:
        """The heaviest first takes in those close to it, with common mean and covariance."""
        s = self.selector
        order = [i for i in np.argsort(-log_weight, kind="stable") if alive[i]]
        if len(order) < 2:
            return mean, P, log_weight, alive
        turns = _turns(-mean[:, 2])
        shift = np.einsum("kij,kmj->kmi", turns, mean[None, :, :2] - mean[:, None, :2])
        turn = 2 * np.sin((mean[None, :, 2] - mean[:, None, 2]) / 2)
        turn = turn * np.where(np.cos((mean[None, :, 2] - mean[:, None, 2]) / 2) < 0, -1, 1)
        apart = np.concatenate([shift, turn[..., None]], -1)
        to_body = np.tile(np.eye(3), (len(mean), 1, 1))
        to_body[:, :2, :2] = turns
        body = to_body @ P[:, :3, :3] @ np.swapaxes(to_body, 1, 2)
        reach = np.hypot(np.hypot(*(mean[:, :2] - self.marker_m[:2]).T), self.marker_m[2])
        linear = s.linear_rad * np.stack([reach, reach, np.ones_like(reach)], 1)
        body = body + np.einsum("ki,ij->kij", linear**2, np.eye(3))
        squared = np.einsum("kmi,kij,kmj->km", apart, np.linalg.inv(body), apart)
        close = squared < s.merge_distance**2
        rank = np.full(len(mean), len(mean))
        rank[order] = np.arange(len(order))
        close &= alive[:, None] & alive[None] & (rank[:, None] < rank[None])
        takes = close & ~np.any(close, axis=0)[:, None]
        for receiver in np.flatnonzero(np.any(takes, axis=1)):
            mine = [m for m in np.flatnonzero(takes[receiver])
                    if rank[receiver] == np.min(rank[takes[:, m]])]  # fmt: skip
            members = [receiver, *mine]
            mass = np.exp(log_weight[members])
            share = mass / np.sum(mass)
            gaps = mean[members] - mean[receiver]
            gaps[:, 2] = _wrapped(gaps[:, 2])
            common = share @ gaps
            spread = gaps - common
            P[receiver] = np.einsum("i,ijk->jk", share, P[members]) + np.einsum(
                "i,ij,ik->jk", share, spread, spread
            )
            mean[receiver] += common
            mean[receiver, 2] = _wrapped(mean[receiver, 2])
            log_weight[receiver] = np.log(np.sum(mass))
            alive[mine] = False
        return mean, P, log_weight, alive

    # The command

    def _steer(
        self, state: Memory, mean: Array, decided: bool, flip: float, selected: int, obs: Reading
    ) -> tuple[Memory, Result]:
        pose = mean[:3]
        p1, p2, most, radius = self.gains
        steering_limit, throttle_limit = self.limits
        index, count = state.waypoint, len(self.waypoints)
        arrived = False
        if decided and index < count:
            arrived = bool(np.hypot(*(self.waypoints[index] - pose[:2])) <= radius)
            index += arrived
        gap = self.waypoints[min(index, count - 1)] - pose[:2]
        distance = float(np.hypot(*gap))
        held = np.clip(obs.steering_rad, -steering_limit, steering_limit)
        beta = np.arctan(np.tan(held) / 2)
        alpha = _wrapped(np.arctan2(gap[1], gap[0]) - pose[2] - beta)
        integral = 0.0 if arrived else state.integral_ms
        state = state._replace(waypoint=index)
        if index >= count:
            return state, Result(pose, 0.0, 0.0, decided, flip, selected)
        if decided:
            steering = self._arc(alpha, distance, beta)
            limit_beta = np.arctan(np.tan(steering_limit) / 2)
            circle = self.wheelbase_m / (np.cos(limit_beta) * np.tan(steering_limit))
            aside = distance * abs(np.sin(alpha)) - circle
            if circle - np.hypot(distance * np.cos(alpha), aside) > radius / 2:
                steering = 0.0
            integral = min(integral + distance * obs.dt_s, most)
            throttle = np.clip(p1 * distance + p2 * integral, -throttle_limit, throttle_limit)
            state = state._replace(integral_ms=integral, explored_s=0.0, side=0.0)
            return state, Result(pose, steering, float(throttle), decided, flip, selected)
        explore = self.controller.exploration
        c, s = np.cos(pose[2]), np.sin(pose[2])
        dx, dy = self.marker_m[:2] - pose[:2]
        ahead, left = c * dx + s * dy, c * dy - s * dx
        bearing = np.arctan2(left, ahead)
        side = state.side or (-1.0 if bearing > 0 else 1.0)
        steering = self._arc(
            _wrapped(bearing + side * explore.angle_rad - beta), explore.reach_m, beta
        )
        goes = state.explored_s < explore.duration_s and np.hypot(ahead, left) > explore.min_range_m
        lead = max(self.lag[0] / explore.settle_s - 1, 0)
        throttle = (explore.speed_mps + lead * (explore.speed_mps - obs.speed_mps)) / self.lag[1]
        throttle = float(np.clip(throttle, 0, throttle_limit)) if goes else 0.0
        state = state._replace(
            integral_ms=integral, explored_s=state.explored_s + obs.dt_s, side=side
        )
        return state, Result(pose, steering, throttle, decided, flip, selected)

    def _arc(self, alpha: float, distance: float, beta: float) -> float:
        limit = self.limits[0]
        if abs(alpha) > np.pi / 2:
            return float(np.copysign(limit, alpha))
        reach = max(distance, 1e-3) * np.cos(beta)
        arc = np.arctan(2 * self.wheelbase_m * np.sin(alpha) / reach)
        return float(np.clip(arc, -limit, limit))


def _minimised(linearised: Any, u: Array, max_steps: int) -> Array:
    """Levenberg-Marquardt of all hypotheses together, next to a unit prior."""
    r, J = linearised(u)
    cost = np.sum(r**2, 1) + np.sum(u**2, 1)
    damping, growth = None, np.full(len(u), 2.0)
    done = np.zeros(len(u), bool)
    for _ in range(max_steps - 1):
        Jt = np.swapaxes(J, 1, 2)
        information = Jt @ J + np.eye(3)
        gradient = (Jt @ r[..., None])[..., 0] + u
        if damping is None:
            damping = 1e-5 * np.max(np.einsum("kii->ki", information), axis=1)
        move = -np.linalg.solve(
            information + damping[:, None, None] * np.eye(3), gradient[..., None]
        )[..., 0]
        promised = np.sum(move * (damping[:, None] * move - gradient), 1)
        r_new, J_new = linearised(u + move)
        cost_new = np.sum(r_new**2, 1) + np.sum((u + move) ** 2, 1)
        accept = (cost_new < cost) & ~done
        gained = (cost - cost_new) / np.where(promised > 0, promised, 1)
        relaxed = np.maximum(1 / 3, 1 - (2 * gained - 1) ** 3)
        done |= promised <= 1e-5 * cost + 1e-5
        damping = damping * np.where(accept, relaxed, growth)
        growth = np.where(accept, 2.0, 2 * growth)
        u = np.where(accept[:, None], u + move, u)
        r = np.where(accept[:, None], r_new, r)
        J = np.where(accept[:, None, None], J_new, J)
        cost = np.where(accept, cost_new, cost)
        if np.all(done):
            break
    return u


def _updated(mean: Array, P: Array, innovation: Array, H: Array, R: Array) -> tuple[Array, Array]:
    """Kalman update of all hypotheses, in Joseph form."""
    HP = H @ P
    Ht = np.swapaxes(H, 1, 2)
    K = np.swapaxes(np.linalg.solve(HP @ Ht + R, HP), 1, 2)
    mean = mean + (K @ innovation[..., None])[..., 0]
    mean[:, 2] = _wrapped(mean[:, 2])
    I_KH = np.eye(6) - K @ H
    return mean, I_KH @ P @ np.swapaxes(I_KH, 1, 2) + K @ R @ np.swapaxes(K, 1, 2)


def _wrapped(angle: Any) -> Any:
    return (angle + np.pi) % (2 * np.pi) - np.pi


def _turns(angle: Array) -> Array:
    c, s = np.cos(angle), np.sin(angle)
    return np.stack([np.stack([c, -s], -1), np.stack([s, c], -1)], -2)


def _moved_back(xi: Array, points: Array) -> Array:
    """Points (K, 4, 3) seen from the pose that the planar twist xi (K, 3) leads to."""
    half = xi[:, 2:] / 2
    norm = 1 + half**2
    c, s = (1 - half**2) / norm, 2 * half / norm
    x = points[..., 0] - (xi[:, :1] - half * xi[:, 1:2]) / norm
    y = points[..., 1] - (xi[:, 1:2] + half * xi[:, :1]) / norm
    return np.stack([c * x + s * y, c * y - s * x, points[..., 2]], -1)


def _cayley_jacobian(xi: Array) -> Array:
    half = xi[:, 2] / 2
    J = np.zeros((len(xi), 3, 3))
    J[:, 0, 0] = J[:, 1, 1] = J[:, 2, 2] = 1
    J[:, 0, 1], J[:, 1, 0] = half, -half
    J[:, 0, 2], J[:, 1, 2] = -xi[:, 1] / 2, xi[:, 0] / 2
    return J / (1 + half**2)[:, None, None]
