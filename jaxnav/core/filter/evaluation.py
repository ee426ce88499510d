"""Comparison of estimates with the truth: the branch that was taken, and position errors."""

import equinox as eqx
import jax
import jax.numpy as jnp
import jaxlie
from jaxtyping import Array, Bool, Float, Int

from jaxnav.core.models.geometry import EVEN_RAD, rotation_error_rad, safe_norm
from jaxnav.core.pose.candidates import Candidates

OUTLIER_DEG = 10.0


class Branch(eqx.Module):
    """Verdict on one choice of a candidate. At most one of `wrong` and `outlier` is True."""

    judged: Bool[Array, ""]  # a candidate was taken
    wrong: Bool[Array, ""]  # another candidate is closer to the truth in angle, by `EVEN_RAD`
    outlier: Bool[Array, ""]  # no candidate lies within 10 degrees of the truth
    ambiguous: Bool[Array, ""]  # there was more than one candidate


def judge_branch(
    candidates: Candidates, selected: Int[Array, ""], T_world_vehicle_true: jaxlie.SE3
) -> Branch:
    """Whether the selected candidate is the one nearest to the truth in angle.

    Args:
        candidates: N poses of one observation.
        selected: index of the candidate that was taken, -1: none.
        T_world_vehicle_true: the true pose.
    """
    angles_rad = jax.vmap(
        lambda T_vehicle_world: rotation_error_rad(T_vehicle_world.inverse(), T_world_vehicle_true)
    )(candidates.T_vehicle_world)
    angles_rad = jnp.where(candidates.valid, angles_rad, jnp.inf)
    nearest_rad = jnp.min(angles_rad)
    judged = selected >= 0
    outlier = judged & (nearest_rad > jnp.deg2rad(OUTLIER_DEG))
    off_rad = angles_rad[jnp.maximum(selected, 0)]
    wrong = judged & ~outlier & (off_rad > nearest_rad + EVEN_RAD)
    return Branch(judged, wrong, outlier, judged & (jnp.sum(candidates.valid) > 1))


def position_error_m(T_a_b: jaxlie.SE3, T_a_c: jaxlie.SE3) -> Float[Array, ""]:
    """Distance between two positions, m."""
    return safe_norm(T_a_b.translation() - T_a_c.translation())
