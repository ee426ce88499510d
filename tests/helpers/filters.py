"""Beliefs, readings and selections made by hand, and one step of a filter that all tests share."""

import dataclasses

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np

from jaxnav.core.filter.bank import Bank
from jaxnav.core.filter.choose import MeasuredPose, Selection
from jaxnav.core.models.geometry import T_world_vehicle_from_planar
from jaxnav.core.pose.candidates import find_candidates
from jaxnav.core.pose.observation import Observation, Snapshot
from jaxnav.core.pose.refine import Candidates
from tests import worlds
from tests.reference import paper
from tests.reference.rigid import matrix


def believing(motion, means, covariances, weights=None) -> Bank:
    """Hypotheses that have started: (n,) and (d, d), or (K, n) and (K, d, d); alike by default."""
    means, P = jnp.asarray(means, float), jnp.asarray(covariances, float)
    means, P = means.reshape(-1, means.shape[-1]), P.reshape(-1, *P.shape[-2:])
    count = len(means)
    share = jnp.full(count, 1 / count, float) if weights is None else jnp.asarray(weights, float)
    return dataclasses.replace(
        motion.init(count),
        mean=means,
        covariance=jnp.broadcast_to(P, (count, *P.shape[-2:])),
        initialised=jnp.ones(count, bool),
        log_weight=jnp.log(share),
    )


def reading(speed_mps=0.0, steering_rad=0.0, has_odometry=True, dt_s=0.1, **told) -> Observation:
    """An observation without corners."""
    return Observation(
        jnp.zeros((1, 1, 4, 2)),
        jnp.zeros((1, 1), bool),
        jnp.asarray(speed_mps, float),
        jnp.asarray(steering_rad, float),
        jnp.asarray(dt_s, float),
        has_odometry=jnp.asarray(has_odometry),
        **{name: jnp.asarray(value, float) for name, value in told.items()},
    )


def level(x_m=0.0, y_m=0.0, psi_rad=0.0) -> np.ndarray:
    """wxyz_xyz (7,) of a vehicle on the ground."""
    return np.array([np.cos(psi_rad / 2), 0, 0, np.sin(psi_rad / 2), x_m, y_m, 0])


def planar_part(covariance, psi_rad):
    """Covariance of (x, y, psi) of a level vehicle from that of xi."""
    c, s = np.cos(psi_rad), np.sin(psi_rad)
    J = np.zeros((3, 6))
    J[:2, :2] = [[c, -s], [s, c]]
    J[2, 5] = 1
    return J @ covariance @ J.T


def chosen(prior: Bank, wxyz_xyz, covariance, taken=True, kept=None) -> Selection:
    """What a selector says that gives every hypothesis this pose, or each its own, or none."""
    count = prior.log_weight.shape[0]
    return Selection(
        measured=MeasuredPose(
            T_world_vehicle=jaxlie.SE3(jnp.broadcast_to(jnp.asarray(wxyz_xyz, float), (count, 7))),
            covariance=jnp.broadcast_to(jnp.asarray(covariance, float), (count, 6, 6)),
            log_likelihood=jnp.zeros(count),
            valid=jnp.full(count, taken),
        ),
        kept=prior.initialised if kept is None else prior.initialised & kept,
        log_weight=prior.log_weight,
        merged_into=jnp.arange(count),
        costs=jnp.zeros(2),
        selected=jnp.where(taken, 0, -1),
        flip_probability=jnp.asarray(0.0),
        decided=jnp.asarray(True),
    )


@jax.jit
def predicted(motion, bank, obs) -> Bank:
    """A prediction alone."""
    return motion.predict(bank, obs)


@jax.jit
def stepped(motion, bank, obs, wxyz_xyz, covariance, taken=True, kept=True):
    """Prediction and update with poses (7,) or (K, 7): both banks, and the NIS."""
    prior = motion.predict(bank, obs)
    posterior, nis, *_ = motion.update(prior, chosen(prior, wxyz_xyz, covariance, taken, kept), obs)
    return prior, posterior, nis


@jax.jit
def find(snapshot: Snapshot) -> Candidates:
    """The candidate poses of a snapshot."""
    return find_candidates(snapshot)


@jax.jit
def select(selector, prior, candidates, snapshot) -> Selection:
    """What a selector makes of them."""
    return selector(prior, candidates, snapshot)


snap = jax.jit(Snapshot.create, static_argnames="max_sightings")
step = jax.jit(lambda navigator, state, obs: navigator.step(state, obs))


@jax.jit
def sense(rig, markers, poses, noise_px, speed_mps=0.0, steering_rad=0.0, dt_s=0.0) -> Observation:
    """What a car sees and reads at planar poses (..., 3), with noise (..., C, M, 4, 2)."""

    def one(pose, noise_px, *numbers):
        told = dict(zip(("speed_mps", "steering_rad", "dt_s"), numbers, strict=True))
        return worlds.observe(rig, markers, T_world_vehicle_from_planar(pose), noise_px, **told)

    lead = poses.shape[:-1]
    for _ in lead:
        one = jax.vmap(one)
    numbers = (
        jnp.broadcast_to(jnp.asarray(x, float), lead) for x in (speed_mps, steering_rad, dt_s)
    )
    return one(poses, noise_px, *numbers)


def whitened_pixels(snapshot: Snapshot, T_world_vehicle: np.ndarray) -> np.ndarray:
    """Projected less observed corners over sigma, in loops over the paper's equations."""
    rig, obs = snapshot.rig, snapshot.obs
    corners = np.asarray(snapshot.markers.corners_world_m)[0]
    sigma_px = float(snapshot.seen.sigma_px[0, 0])
    residuals = []
    for j in np.flatnonzero(np.asarray(obs.visible)[:, 0]):
        camera = rig.camera(int(j))
        K, k = np.asarray(camera.K), np.asarray(camera.distortion)
        T_camera_vehicle = matrix(rig.Ts_camera_vehicle.wxyz_xyz[j])
        T_camera_world = T_camera_vehicle @ np.linalg.inv(T_world_vehicle)
        for corner, pixel in zip(corners, np.asarray(obs.corners_px)[j, 0], strict=True):
            point = (T_camera_world @ np.append(corner, 1))[:3]
            residuals.append((paper.project(K, "equidistant", k, point) - pixel) / sigma_px)
    return np.ravel(residuals)


def derivative(function, x, h=1e-5) -> np.ndarray:
    """Of a vector by a vector, by central differences."""
    columns = [(function(x + h * e) - function(x - h * e)) / (2 * h) for e in np.eye(len(x))]
    return np.stack(columns, axis=1)
