"""The probability that a hypothesis is of another branch than the reported pose."""

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
from jaxtyping import Array, Float, Int

from jaxnav.core.models.geometry import safe_norm, safe_sqrt, shift_and_turn
from jaxnav.core.pose.candidates import SAME_POSE_RAD, Candidates


def nearer_to_another(
    T_world_vehicle: jaxlie.SE3,
    covariance: Float[Array, "K 6 6"],
    candidates: Candidates,
    selected: Int[Array, ""],
) -> Float[Array, " K"]:
    """Probability that a candidate is nearer in angle than the selected one, for each hypothesis.

    Between two candidates lies a bisector: a pose is nearer to the other one beyond it. Another one
    is another index, and farther off than candidates that merge: of the selected one, computed
    twice, the two roundings are a distance as well.
    """
    base = T_world_vehicle.wxyz_xyz
    other = jax.vmap(lambda T: T.inverse().wxyz_xyz)(candidates.T_vehicle_world)
    between = jax.vmap(jax.vmap(shift_and_turn, (None, 0)), (0, None))(base, other)
    turns = between[..., 3:]  # (K, N, 3)
    own = turns[:, selected]
    across = turns - own[:, None]
    is_other = candidates.valid & (jnp.arange(candidates.valid.shape[0]) != selected)
    is_other = is_other[None] & (safe_norm(across) >= SAME_POSE_RAD)
    across = jnp.where(is_other[..., None], across, 1)
    length = safe_norm(across)
    direction = across / length[..., None]
    gap = jnp.sum(turns**2, axis=2) - jnp.sum(own**2, axis=1)[:, None]
    gap_rad = gap / (2 * length)
    P = covariance[:, None, 3:, 3:]
    variance = jnp.sum(direction[..., None] * P * direction[..., None, :], axis=(2, 3))
    sigma_rad = jnp.maximum(safe_sqrt(jnp.maximum(variance, 0)), 1e-6)
    nearer = jax.scipy.special.erfc(gap_rad / (np.sqrt(2) * sigma_rad)) / 2
    return jnp.max(jnp.where(is_other, nearer, 0), axis=1)


def beyond(
    limit_rad: Float[Array, ""] | float,
    apart_rad: Float[Array, " K"],
    sigma_rad: Float[Array, " K"],
) -> Float[Array, " K"]:
    """Probability that |N(apart_rad, sigma_rad^2)| exceeds a limit, for each hypothesis."""
    scale = np.sqrt(2) * jnp.maximum(sigma_rad, 1e-6)
    below, above = (limit_rad - apart_rad) / scale, (limit_rad + apart_rad) / scale
    return (jax.scipy.special.erfc(below) + jax.scipy.special.erfc(above)) / 2
