"""The first hypotheses of a bank: a fan over the directions a marker may be seen from.

A single candidate gives range and bearing of the marker well; only the viewing direction is open.
See docs/design.md, Cold start.
"""

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
from jaxtyping import Array, Float

from jaxnav.core.filter.ambiguity import PoseBelief
from jaxnav.core.linalg.small_matrices import product, sandwich
from jaxnav.core.models.geometry import (
    on_ground,
    rotation_matrix,
    safe_atan2,
    safe_norm,
    wrap_angle,
)
from jaxnav.core.pose.candidates import Candidates
from jaxnav.core.pose.observation import Snapshot

CANDIDATES = 3  # largest number of candidates beside the fan
_FAN_RAD = float(np.deg2rad(80.0))  # largest viewing angle, from the marker's normal
_RANGE_SIGMA = 0.1  # sigma of the start, as a share of the range
_BEARING_SIGMA_RAD = 0.1
_CANDIDATE_LOG_WEIGHT = -5.0  # of a candidate, where a member of the fan has 0


def fan(
    prior: PoseBelief, candidates: Candidates, snapshot: Snapshot, hypotheses: int
) -> PoseBelief:
    """K hypotheses: the best candidate turned about the marker, then up to three candidates.

    The fan of a car turns about the vertical through the marker's centre, that of a free body in
    two angles. The candidates weigh little; they serve markers that do not hang upright, whose
    corners no member of a car's fan explains.

    Args:
        prior: an empty bank: its `freedom` says whether the vehicle is a car.
        candidates: the first is turned about the largest marker in view.
        snapshot: what is seen.
        hypotheses: K.
    """
    slots = min(candidates.valid.shape[0], CANDIDATES)
    count = hypotheses - slots
    T_world_vehicle = jax.tree.map(lambda leaf: leaf[0], candidates.T_vehicle_world).inverse()
    largest = jnp.argmax(snapshot.seen.visible)
    T_world_marker = jaxlie.SE3(
        snapshot.markers.Ts_world_marker.wxyz_xyz[snapshot.seen.marker_index[largest]]
    )
    T_camera_vehicle = jaxlie.SE3(
        snapshot.rig.Ts_camera_vehicle.wxyz_xyz[snapshot.seen.camera_index[largest]]
    )
    center = T_world_marker.translation()
    T_world_camera = T_world_vehicle @ T_camera_vehicle.inverse()
    towards = T_world_camera.translation() - center
    planar = prior.freedom.shape[1] == 3
    if planar:
        turns, axes, sigma_rad = _planar_fan(T_world_marker, towards, count)
    else:
        turns, axes, sigma_rad = _spherical_fan(T_world_marker, towards, count)
    pivot = jaxlie.SE3.from_translation(center)
    turned = jax.vmap(
        lambda wxyz: (
            (
                pivot
                @ jaxlie.SE3.from_rotation(jaxlie.SO3(wxyz))
                @ pivot.inverse()
                @ T_world_vehicle
            ).wxyz_xyz
        )
    )(turns)
    Ts_candidate = jax.vmap(lambda T: T.inverse())(candidates.T_vehicle_world).wxyz_xyz[:slots]
    Ts_world_vehicle = jaxlie.SE3(jnp.concatenate([turned, Ts_candidate]))
    if planar:
        Ts_world_vehicle = on_ground(Ts_world_vehicle)
    axes = jnp.concatenate([axes, jnp.broadcast_to(axes[:1], (slots, *axes.shape[1:]))])
    kept = product(prior.freedom, prior.freedom.T)
    range_m = safe_norm(towards)

    def covariance(T: jaxlie.SE3, axes: Array) -> Array:
        R = rotation_matrix(T.rotation())
        swing = jnp.cross(axes, (T.translation() - center)[None])
        about = jnp.concatenate([product(swing, R), product(axes, R)], axis=1)  # (axes, 6)
        local = jnp.concatenate(
            [jnp.full(3, _RANGE_SIGMA * range_m), jnp.full(3, _BEARING_SIGMA_RAD)]
        )
        return sandwich(kept, sigma_rad**2 * product(about.T, about) + jnp.diag(local**2))

    light = jnp.concatenate([jnp.zeros(count), jnp.full(slots, _CANDIDATE_LOG_WEIGHT)])
    alive = jnp.concatenate([jnp.ones(count, bool), candidates.valid[:slots]])
    return PoseBelief(
        T_world_vehicle=Ts_world_vehicle,
        covariance=jax.vmap(covariance)(Ts_world_vehicle, axes),
        log_weight=normalise(jnp.where(alive, light.astype(range_m.dtype), -jnp.inf)),
        initialised=alive,
        freedom=prior.freedom,
        nuisance=prior.nuisance,
        gate_nis=prior.gate_nis,
        errors=None if prior.errors is None else prior.errors.fresh(),
    )


def _planar_fan(
    T_world_marker: jaxlie.SE3, towards: Float[Array, " 3"], count: int
) -> tuple[Array, Array, float]:
    """Turns about the vertical: viewing angles from -80 to 80 degrees.

    Args:
        towards: from the marker to the camera, world.

    Returns:
        Quaternions (count, 4), axes of uncertainty (count, 1, 3), its sigma in rad.
    """
    normal = rotation_matrix(T_world_marker.rotation())[:, 2]
    azimuth_rad = wrap_angle(safe_atan2(towards[1], towards[0]) - safe_atan2(normal[1], normal[0]))
    angles_rad = jnp.linspace(-_FAN_RAD, _FAN_RAD, count, dtype=towards.dtype) - azimuth_rad
    zero = jnp.zeros_like(angles_rad)
    turns = jnp.stack([jnp.cos(angles_rad / 2), zero, zero, jnp.sin(angles_rad / 2)], axis=1)
    vertical = jnp.asarray([0.0, 0.0, 1.0], towards.dtype)
    axes = jnp.broadcast_to(vertical, (count, 1, 3))
    return turns, axes, 2 * _FAN_RAD / max(count - 1, 1)


def _spherical_fan(
    T_world_marker: jaxlie.SE3, towards: Float[Array, " 3"], count: int
) -> tuple[Array, Array, float]:
    """Turns in both angles: viewing directions evenly over a cap of 80 degrees.

    Args and result as `_planar_fan`, with two axes. Source of the spiral: Vogel (1979).
    """
    share = (np.arange(count) + 0.5) / count
    cosine = 1 - share * (1 - np.cos(_FAN_RAD))
    azimuth = np.arange(count) * np.pi * (3 - np.sqrt(5))
    sine = np.sqrt(1 - cosine**2)
    views = jnp.asarray(
        np.column_stack([sine * np.cos(azimuth), sine * np.sin(azimuth), cosine]), towards.dtype
    )
    R_world_marker = T_world_marker.rotation()
    direction = R_world_marker.inverse() @ towards
    direction = direction / jnp.maximum(safe_norm(direction), 1e-9)
    # Through the frontal view, so that the marker does not seem to roll.
    to_frontal = _shortest_turn(direction).inverse()
    turns_marker = jax.vmap(lambda v: (_shortest_turn(v) @ to_frontal).wxyz)(views)
    turns = jax.vmap(
        lambda wxyz: (R_world_marker @ jaxlie.SO3(wxyz) @ R_world_marker.inverse()).wxyz
    )(turns_marker)
    Rs = jax.vmap(lambda v: rotation_matrix(R_world_marker @ _shortest_turn(v)))(views)
    axes = jnp.swapaxes(Rs[:, :, :2], 1, 2)
    area = 2 * np.pi * (1 - np.cos(_FAN_RAD)) / count
    return turns, axes, float(np.sqrt(area) / 2)


def _shortest_turn(direction: Float[Array, " 3"]) -> jaxlie.SO3:
    """The rotation that carries (0, 0, 1) into a unit vector not opposite to it."""
    x, y, z = direction
    wxyz = jnp.stack([jnp.maximum(1 + z, 1e-3), -y, x, jnp.zeros_like(x)])
    return jaxlie.SO3(wxyz).normalize()


def normalise(log_weight: Float[Array, " K"]) -> Float[Array, " K"]:
    """Log-weights shifted so that the weights sum to 1; unchanged where none is finite."""
    highest = jnp.max(log_weight)
    any_finite = jnp.isfinite(highest)
    shifted = jnp.where(any_finite, log_weight - jnp.where(any_finite, highest, 0), 0)
    return jnp.where(any_finite, shifted - jnp.log(jnp.sum(jnp.exp(shifted))), log_weight)
