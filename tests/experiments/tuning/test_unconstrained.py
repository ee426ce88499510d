"""Parameters as unconstrained numbers: there and back, and always inside the allowed values."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.linalg import cholesky
from scipy.special import expit

from jaxnav.core.filter.choose import LowestReprojection
from jaxnav.core.navigator import Navigator
from jaxnav.core.parameters import TUNABLES, parameters_of, with_parameters
from jaxnav.experiments.tuning.unconstrained import Space
from tests import worlds
from tests.derivatives import check_derivatives

RIG, MARKERS = worlds.qcar_rig_by_hand(), worlds.paper_markers()
CAR = Navigator(RIG, MARKERS, worlds.qcar_by_hand(), worlds.WAYPOINTS_M)
HANDHELD = Navigator(RIG, MARKERS, selector=LowestReprojection())
NAVIGATORS = pytest.mark.parametrize("navigator", [CAR, HANDHELD], ids=["car", "hand-held"])
MATRICES = frozenset(name for name, tunable in TUNABLES.items() if tunable.matrix is not None)


def everything(navigator: Navigator, full: frozenset[str] = frozenset()) -> Space:
    return Space.from_navigator(navigator, dict.fromkeys(parameters_of(navigator), True), full)


@functools.cache
def there_and_back(navigator: Navigator, full: frozenset[str] = frozenset()):
    def values(values):
        space = everything(with_parameters(navigator, values), full)
        return space.start, space.values(space.start)

    return jax.jit(values)


@functools.cache
def compiled(navigator: Navigator, full: frozenset[str] = frozenset()):
    """The values at any x, and a derivative of them all."""
    space = everything(navigator, full)

    def bounded_sum(x):
        values = space.values(x)
        return sum(jnp.sum(jnp.tanh(value)) for value in values.values())

    return space, jax.jit(lambda x: space.values(x)), jax.jit(jax.grad(bounded_sum))


def random_covariance(rng: np.random.Generator, d: int, scale: float) -> np.ndarray:
    root = rng.normal(size=(d, d)) + 0.5 * np.eye(d)
    sigma = np.diag(scale * 10 ** rng.uniform(-2, 2, d))
    return sigma @ root @ root.T @ sigma


@NAVIGATORS
@settings(max_examples=40)
@given(seed=st.integers(0, 10**6), decades=st.floats(0, 7))
def test_there_and_back(navigator, seed, decades):
    """Seven powers of ten to either side of what is typical."""
    rng = np.random.default_rng(seed)
    values = {
        name: jnp.minimum(
            TUNABLES[name].typical * 10 ** rng.uniform(-decades, decades, np.shape(value)),
            TUNABLES[name].largest(np.shape(value)),
        )
        for name, value in parameters_of(navigator).items()
    }
    x, found = there_and_back(navigator)(values)
    assert np.all(np.isfinite(x))
    assert set(found) == set(values)
    for name, value in values.items():
        np.testing.assert_allclose(found[name], value, rtol=1e-9, err_msg=name)


@pytest.mark.parametrize("seed", range(5))
@NAVIGATORS
def test_matrices_there_and_back(navigator, seed):
    """A covariance as one, and one whose diagonal alone is tuned."""
    rng = np.random.default_rng(seed)
    values = {
        name: jnp.asarray(random_covariance(rng, value.shape[0], TUNABLES[name].typical))
        for name, value in parameters_of(navigator).items()
        if name in MATRICES
    }
    _, found = there_and_back(navigator, MATRICES & set(values))(values)
    _, diagonal = there_and_back(navigator)(values)
    for name, value in values.items():
        np.testing.assert_allclose(found[name], value, rtol=1e-9, err_msg=name)
        variances = np.diagonal(value)
        sigma = np.sqrt(variances) if TUNABLES[name].matrix == "sigma" else variances
        np.testing.assert_allclose(diagonal[name], sigma, rtol=1e-9, err_msg=name)


def test_a_vector_stands_for_a_diagonal_covariance():
    space, values, _ = compiled(CAR, MATRICES)
    for name, value in values(space.start).items():
        known = np.asarray(parameters_of(CAR)[name])
        if name in MATRICES:
            known = np.diag(known**2 if TUNABLES[name].matrix == "sigma" else known)
        if np.all(np.isfinite(known)) and name != "repeated_errors.least_share":  # which is 0
            np.testing.assert_allclose(value, known, rtol=1e-9, atol=1e-15, err_msg=name)


def test_at_zero_everything_is_typical():
    space, values, _ = compiled(CAR)
    for name, value in values(jnp.zeros_like(space.start)).items():
        np.testing.assert_allclose(value, TUNABLES[name].typical, rtol=1e-12)
    for name, value in compiled(CAR, MATRICES)[1](0 * everything(CAR, MATRICES).start).items():
        if name in MATRICES:
            typical = TUNABLES[name].typical
            variance = typical**2 if TUNABLES[name].matrix == "sigma" else typical
            np.testing.assert_allclose(value, variance * np.eye(3), rtol=1e-12)


@pytest.mark.parametrize("nothing", [0.0, np.inf])
@pytest.mark.parametrize("full", [frozenset(), MATRICES], ids=["diagonal", "full"])
def test_what_is_not_known_starts_at_what_is_typical(nothing, full):
    """No noise at all, or a gain that does nothing: no logarithm of either."""
    known = parameters_of(CAR)
    values = {name: jnp.full(value.shape, nothing) for name, value in known.items()}
    x, found = there_and_back(CAR, full)(values)
    np.testing.assert_allclose(x, 0, atol=1e-12)
    for name, value in found.items():
        if name not in full:
            np.testing.assert_allclose(value, TUNABLES[name].typical, rtol=1e-12)


@NAVIGATORS
@settings(max_examples=60)
@given(seed=st.integers(0, 10**6), scale=st.sampled_from([1.0, 30.0, 1e3, 1e30]))
def test_no_x_leads_out_of_what_is_allowed(navigator, seed, scale):
    full = MATRICES & set(parameters_of(navigator))
    for matrices in (frozenset(), full):
        space, values, slope = compiled(navigator, matrices)
        x = scale * np.random.default_rng(seed).normal(size=space.start.shape)
        found = values(jnp.asarray(x))
        for name, value in found.items():
            value = np.asarray(value)
            assert np.all(np.isfinite(value)), name
            if name in matrices:
                np.testing.assert_array_equal(value, value.T)
                assert np.all(np.diagonal(value) > 0)
                if scale == 1:
                    assert np.all(np.linalg.eigvalsh(value) > 0)
            else:
                assert np.all(value > 0), name
        assert np.all(np.isfinite(slope(jnp.asarray(x))))
    with_parameters(navigator, found)  # fits


@pytest.mark.parametrize("full", [frozenset(), MATRICES], ids=["diagonal", "full"])
@pytest.mark.parametrize("extreme", [-1e30, -1e3, -20.0, 0.0, 20.0, 1e3, 1e30])
def test_numbers_and_gradients_are_finite_in_float32_as_well(extreme, full):
    with jax.enable_x64(False):
        car = jax.tree.map(
            lambda leaf: leaf.astype(np.float32) if leaf.dtype == np.float64 else leaf,
            jax.tree.map(jnp.asarray, jax.device_get(CAR)),
        )
        space = everything(car, full)
        x = jnp.full_like(space.start, extreme)
        assert x.dtype == np.float32
        for name, value in space.values(x).items():
            assert np.all(np.isfinite(value)), name
            assert np.all(np.diagonal(value) > 0 if name in full else value > 0), name
        slope = jax.grad(lambda x: sum(jnp.sum(jnp.tanh(v)) for v in space.values(x).values()))(x)
        assert np.all(np.isfinite(slope))


def test_a_full_one_is_log_cholesky():
    """By scipy's factor of the covariance in units of what is typical."""
    rng, name = np.random.default_rng(3), "motion.odometry_sigma"
    P = random_covariance(rng, 3, 0.01)
    navigator = with_parameters(CAR, {name: jnp.asarray(P)})
    space = Space.from_navigator(navigator, {name: True}, frozenset({name}))
    L = cholesky(P, lower=True) / TUNABLES[name].typical
    expected = np.tril(L, -1) + np.diag(np.log(np.diagonal(L)))
    np.testing.assert_allclose(space.start.reshape(3, 3), expected, rtol=1e-9, atol=1e-12)


def test_a_gain_is_a_softplus():
    """Its slope is that of the logistic function, in units of what is typical over log 2."""
    name = "controller.proportional_per_m"
    space = Space.from_navigator(CAR, {name: True})
    for x in (-5.0, 0.0, 3.0, 30.0):
        slope = jax.grad(lambda x: space.values(x)[name].sum())(jnp.asarray([x]))
        expected = TUNABLES[name].typical / np.log(2) * expit(x)
        np.testing.assert_allclose(slope, expected, rtol=1e-9)


@pytest.mark.parametrize("full", [frozenset(), MATRICES], ids=["diagonal", "full"])
def test_derivatives(full):
    space, values, _ = compiled(CAR, full)
    x = jnp.asarray(np.random.default_rng(1).normal(size=space.start.shape))
    check_derivatives(lambda x: values(x), x, atol=1e-8)


def test_labels_say_whose_an_entry_is():
    """Moving one entry moves the values of its name and no other's; nothing, above a diagonal."""
    full = frozenset({"motion.odometry_sigma"})
    trainable = {
        "selector.floor_m": True, "motion.odometry_sigma": True, "corner_sigma_px": False,
        "controller.lookahead_m": True, "motion.acceleration_density": True,
    }  # fmt: skip
    space = Space.from_navigator(CAR, trainable, full)
    assert set(space.labels) == {name for name, moves in trainable.items() if moves}
    assert len(space.labels) == space.start.size == 1 + 9 + 1 + 3
    jacobian = jax.jit(jax.jacobian(lambda x: space.values(x)))(space.start + 0.3)
    for entry, label in enumerate(space.labels):
        for name, slopes in jacobian.items():
            moves = np.any(np.asarray(slopes)[..., entry] != 0)
            assert not moves or name == label
    for name, slopes in jacobian.items():
        moves = np.any(np.asarray(slopes) != 0, axis=tuple(range(slopes.ndim - 1)))
        assert moves.sum() == {1: 1, 3: 3, 9: 6}[space.labels.count(name)]


def test_what_can_t_be_is_named():
    with pytest.raises(ValueError, match=r"motion.mass_kg: unknown: expected one of motion\."):
        Space.from_navigator(CAR, {"motion.mass_kg": True})
    with pytest.raises(ValueError, match=r"controller\.lookahead_m: unknown"):
        Space.from_navigator(HANDHELD, {"controller.lookahead_m": True})
    with pytest.raises(ValueError, match=r"selector\.floor_m: is no covariance"):
        Space.from_navigator(CAR, {"selector.floor_m": True}, frozenset({"selector.floor_m"}))
    assert Space.from_navigator(CAR, {"motion.mass_kg": False}).start.size == 0
