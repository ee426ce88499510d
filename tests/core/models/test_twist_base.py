"""The motion of a base by a twist, against the exponential of the group."""

import jax
import jax.numpy as jnp
import numpy as np
from scipy.linalg import expm

from jaxnav.core.models.vehicle import advance_twist
from tests.derivatives import check_derivatives


def matrix(pose):
    x, y, psi = pose
    return np.array([[np.cos(psi), -np.sin(psi), x], [np.sin(psi), np.cos(psi), y], [0, 0, 1]])


def test_a_twist_moves_along_the_exponential(precision):
    rng = np.random.default_rng(0)
    moved = jax.jit(advance_twist)
    atol = 2e-6 if precision == np.float32 else 1e-12
    for turn_radps in (0.0, 1e-6, 0.3, -7.0):
        pose, twist, dt_s = rng.normal(size=3), np.append(rng.normal(size=2), turn_radps), 0.7
        x, y, turn = twist * dt_s
        after = matrix(pose) @ expm(np.array([[0, -turn, x], [turn, 0, y], [0, 0, 0]]))
        got = moved(*(jnp.asarray(value, float) for value in (pose, twist, dt_s)))
        np.testing.assert_allclose(matrix(got), after, atol=atol)
        np.testing.assert_allclose(got[2], pose[2] + turn, atol=atol)


def test_derivatives_are_finite_on_a_straight_way():
    check_derivatives(advance_twist, jnp.zeros(3), jnp.asarray([1.0, 0.5, 0.0]), jnp.asarray(0.1))
