"""Steps of an optimiser, one at a time: against SciPy's minima and a handwritten Adam."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import minimize

from jaxnav.experiments.tuning.descent import Descent, Noisy, Smooth

ZERO = jnp.zeros(())
SCALES = np.array([1.0, 30.0, 0.1, 5.0])


def rosenbrock(x, batch, softness):
    return jnp.sum(100 * (x[1:] - x[:-1] ** 2) ** 2 + (1 - x[:-1]) ** 2) + softness


def quadratic(x, batch, softness):
    return jnp.sum(jnp.asarray(SCALES, x.dtype) * (x - batch) ** 2) / 2 + softness


def descended(optimiser, x, batch, steps) -> Descent:
    state = optimiser.init(x, batch, ZERO)
    for _ in range(steps):
        state = optimiser.step(state, batch, ZERO)
        if state.over:
            break
    return state


@pytest.mark.parametrize(
    ("loss", "begin", "batch"),
    [
        (rosenbrock, [-1.2, 1.0, 0.5], np.zeros(())),
        (quadratic, [3.0, -2.0, 1.0, 0.0], np.array([0.5, 1.0, -1.0, 2.0])),
    ],
)
def test_smooth_ends_where_scipy_does(loss, begin, batch):
    batch = jnp.asarray(batch)
    value_and_grad = jax.jit(jax.value_and_grad(lambda x: loss(x, batch, 0.0)))
    expected = minimize(
        lambda x: tuple(map(np.asarray, value_and_grad(jnp.asarray(x)))),
        begin, jac=True, method="BFGS", tol=1e-10,
    )  # fmt: skip
    found = descended(Smooth(loss, 1e-10, 1e-10), jnp.asarray(begin), batch, 300)
    assert found.over
    assert found.finite
    np.testing.assert_allclose(found.x, expected.x, atol=1e-6)
    value, gradient = value_and_grad(found.x)
    assert found.loss == pytest.approx(float(value), abs=1e-12)
    np.testing.assert_allclose(found.gradient, gradient, atol=1e-9)
    np.testing.assert_array_equal(found.asked_x, found.x)


def test_smooth_never_goes_up(precision):
    batch, losses = jnp.asarray(0.0, precision), []
    smooth = Smooth(rosenbrock)
    softness = jnp.asarray(0.5, precision)
    state = smooth.init(jnp.asarray([-1.2, 1.0, 0.5], precision), batch, softness)
    assert np.isinf(state.loss)
    assert state.x.dtype == precision
    for _ in range(20):
        state = smooth.step(state, batch, softness)
        losses.append(float(state.loss))
        assert state.loss == pytest.approx(float(rosenbrock(state.x, batch, softness)), rel=1e-5)
    assert np.all(np.diff(losses) <= 0)
    assert losses[-1] < losses[0] / 2


def test_noisy_is_adam():
    """With clipped gradients, and a learning rate that falls along a cosine to a tenth."""
    rng, steps, rate = np.random.default_rng(0), 12, 0.2
    noisy = Noisy(jax.value_and_grad(quadratic), rate, steps=10, longest=2.0)
    x = np.array([3.0, -2.0, 1.0, 0.0])
    state = noisy.init(jnp.asarray(x), None, ZERO)
    first, second = np.zeros(4), np.zeros(4)
    for step in range(steps):
        target = rng.normal(size=4)
        state = noisy.step(state, jnp.asarray(target), ZERO)
        gradient = SCALES * (x - target)
        np.testing.assert_allclose(state.gradient, gradient, rtol=1e-12)
        assert state.loss == pytest.approx(np.sum(SCALES * (x - target) ** 2) / 2)
        np.testing.assert_allclose(state.asked_x, x, rtol=1e-12)
        gradient = gradient * min(1.0, 2.0 / np.linalg.norm(gradient))
        first = 0.9 * first + 0.1 * gradient
        second = 0.99 * second + 0.01 * gradient**2
        corrected = first / (1 - 0.9 ** (step + 1)), second / (1 - 0.99 ** (step + 1))
        cosine = (1 + np.cos(np.pi * min(step / 10, 1))) / 2
        x = x - rate * (0.1 + 0.9 * cosine) * corrected[0] / (np.sqrt(corrected[1]) + 1e-8)
        np.testing.assert_allclose(state.x, x, rtol=1e-9)
        assert not state.over


def breaks_below_half(x, batch, softness):
    """A finite loss whose gradient is no number there: 0 times the slope of a root at 0."""
    return jnp.sum(x**2) + batch * jnp.sum(jnp.sqrt(jnp.maximum(x - 0.5, 0)))


def not_a_number_below_half(x, batch, softness):
    return jnp.sum(x**2) + jnp.where(jnp.any(x < 0.5), jnp.nan, 0.0)


OPTIMISERS = {"smooth": Smooth, "noisy": lambda loss: Noisy(jax.value_and_grad(loss), 0.3)}


@pytest.mark.parametrize("make", OPTIMISERS.values(), ids=OPTIMISERS)
@pytest.mark.parametrize("loss", [breaks_below_half, not_a_number_below_half])
def test_what_is_no_number_is_never_stepped_on(make, loss):
    """At the start already: the state says so, stays, and goes on with a better batch."""
    optimiser, x = make(loss), jnp.asarray([0.2, 0.9])
    state = optimiser.init(x, ZERO, ZERO)
    before = state
    for _ in range(2):
        state = optimiser.step(state, ZERO, ZERO)
        assert not state.finite
        assert not state.over
        np.testing.assert_array_equal(state.x, x)
        np.testing.assert_array_equal(state.asked_x, x)
        assert np.isinf(state.loss)
        for leaf, other in zip(
            jax.tree.leaves(state.inner), jax.tree.leaves(before.inner), strict=True
        ):
            np.testing.assert_array_equal(leaf, other)


@pytest.mark.parametrize("make", OPTIMISERS.values(), ids=OPTIMISERS)
def test_it_stops_before_the_gradient_that_breaks(make):
    """On the way down; where it was asked for is told, and the loss stays that of x."""
    optimiser = make(breaks_below_half)
    state = optimiser.init(jnp.asarray([3.0, 3.0]), ZERO, ZERO)
    for _ in range(40):
        before, state = state, optimiser.step(state, ZERO, ZERO)
        if not state.finite:
            break
    assert not state.finite
    np.testing.assert_array_equal(state.x, before.x)
    assert state.loss == before.loss
    assert np.any(state.asked_x < 0.5)
    assert not np.all(np.isfinite(state.gradient))


def test_a_trial_that_is_no_number_is_taken_back():
    """A line search looks farther than it goes: it comes back, and ends beside the edge."""
    state = descended(Smooth(not_a_number_below_half), jnp.asarray([3.0, 3.0]), ZERO, 60)
    assert state.finite
    assert np.all(np.isfinite(state.x))
    assert np.all(state.x >= 0.5)
    assert state.loss < 8
