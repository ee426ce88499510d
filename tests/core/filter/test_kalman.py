"""The linear filter against the textbook, and over many float32 steps."""

import jax
import jax.numpy as jnp
import numpy as np
from scipy.integrate import quad_vec
from scipy.linalg import expm

from jaxnav.core.filter import kalman

update = jax.jit(kalman.update)
hide_rows = jax.jit(kalman.hide_rows)


def random_problem(seed: int, n: int = 6, m: int = 5):
    rng = np.random.default_rng(seed)
    root_P, root_R = rng.normal(size=(n, n)), rng.normal(size=(m, m))
    return (
        root_P @ root_P.T + 0.1 * np.eye(n),
        rng.normal(size=m),
        rng.normal(size=(m, n)),
        root_R @ root_R.T + 0.1 * np.eye(m),
    )


def textbook(P, innovation, H, R):
    S = H @ P @ H.T + R
    K = P @ H.T @ np.linalg.inv(S)
    return K @ innovation, (np.eye(len(P)) - K @ H) @ P, S


def test_update_is_the_textbook_s():
    for seed in range(5):
        problem = random_problem(seed)
        found = update(*map(jnp.asarray, problem))
        for result, expected in zip(found, textbook(*problem), strict=True):
            np.testing.assert_allclose(result, expected, atol=1e-9)


def test_states_behind_the_measured_ones_are_corrected_along():
    """Rows of the first states alone are rows whose other columns are 0."""
    P, innovation, H, R = random_problem(7)
    padded = np.pad(H[:, :4], ((0, 0), (0, 2)))
    results = update(*map(jnp.asarray, (P, innovation, H[:, :4], R)))
    for result, expected in zip(results, textbook(P, innovation, padded, R), strict=True):
        np.testing.assert_allclose(result, expected, atol=1e-9)
    F = np.vstack([padded[:2], np.eye(6)[2:]])
    replaced = jax.jit(kalman.replace_first)(jnp.asarray(P), jnp.asarray(H[:2, :4]))
    np.testing.assert_allclose(replaced, F @ P @ F.T, atol=1e-9)


def test_hidden_rows_are_rows_left_out():
    P, innovation, H, R = random_problem(9)
    for present in ([1, 0, 1, 1, 0], [0, 0, 0, 0, 0], [1, 1, 1, 1, 1], [0, 0, 0, 0, 1]):
        hidden = hide_rows(*map(jnp.asarray, (innovation, H, R)), jnp.asarray(present, float))
        kept = np.flatnonzero(present)
        expected = textbook(P, innovation[kept], H[kept], R[np.ix_(kept, kept)])
        correction, posterior, S = update(jnp.asarray(P), *hidden)
        np.testing.assert_allclose(correction, expected[0], atol=1e-9)
        np.testing.assert_allclose(posterior, expected[1], atol=1e-9)
        np.testing.assert_allclose(S[np.ix_(kept, kept)], expected[2], atol=1e-12)


def test_covariance_outlives_1e5_float32_steps():
    """Precise measurements of half of the state: where (I - K H) P loses its variances."""

    def step(P, _):
        A = jnp.eye(6, dtype=jnp.float32) + 0.02 * jnp.eye(6, k=3, dtype=jnp.float32)
        Q = kalman.white_acceleration(jnp.full(3, 1e-8, jnp.float32), jnp.float32(0.02))
        P = kalman.replace_first(P, A) + Q
        H = jnp.eye(3, 6, dtype=jnp.float32)
        R = jnp.diag(jnp.asarray([1e-8, 1e-6, 1e-2], jnp.float32))
        _, P, _ = kalman.update(P, jnp.zeros(3, jnp.float32), H, R)
        return P, None

    @jax.jit
    def run(P):
        def many(P, _):
            return jax.lax.scan(step, P, None, length=1000)[0], jnp.min(jnp.linalg.eigvalsh(P))

        return jax.lax.scan(many, P, None, length=100)

    P, smallest = run(jnp.diag(jnp.asarray([1e2, 1e-2, 1.0, 1e2, 1.0, 1e-4], jnp.float32)))
    assert P.dtype == jnp.float32
    assert np.all(np.isfinite(P))
    np.testing.assert_array_equal(P, P.T)
    assert np.all(np.diagonal(P) > 0)
    assert np.all(np.asarray(smallest) > 0)
    assert np.linalg.eigvalsh(np.asarray(P, float)).min() > 0


def test_nis_is_chi_square():
    _, _, H, _ = random_problem(3)
    S = jnp.asarray(H @ H.T + np.eye(5))
    draws = np.random.default_rng(0).multivariate_normal(np.zeros(5), np.asarray(S), 4000)
    values = jax.jit(jax.vmap(lambda y: kalman.nis(y, S)))(jnp.asarray(draws))
    assert abs(np.mean(values) - 5) < 4 * np.sqrt(10 / 4000)
    assert abs(np.var(values) - 10) < 1.5
    expected = draws[0] @ np.linalg.inv(S) @ draws[0]
    np.testing.assert_allclose(values[0], expected, rtol=1e-12)


def test_process_noise_is_the_integral():
    """Q = integral over dt of exp(F s) G D G' exp(F s)'."""
    density, dt_s = np.array([1.5, 0.3]), 0.7
    F = np.eye(4, k=2)
    G = np.vstack([np.zeros((2, 2)), np.eye(2)])

    def integrand(s):
        reach = expm(F * s) @ G
        return reach @ np.diag(density) @ reach.T

    expected = quad_vec(integrand, 0, dt_s)[0]
    np.testing.assert_allclose(
        kalman.white_acceleration(jnp.asarray(density), dt_s), expected, atol=1e-12
    )
