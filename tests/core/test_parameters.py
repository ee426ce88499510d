"""Tunable parameters by name: every name changes its number, and other numbers stay."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxnav.core.control import ControlInput, ControlState
from jaxnav.core.filter.choose import LowestReprojection, PaperCost, Ungated
from jaxnav.core.filter.free import ConstantVelocity
from jaxnav.core.filter.planar import BicycleKalman
from jaxnav.core.models.imu import GYROS
from jaxnav.core.models.vehicle import OdometryErrors, TwistBase, default_odometry_sigma
from jaxnav.core.navigator import Navigator
from jaxnav.core.parameters import TUNABLES, allowed_shapes, parameters_of, with_parameters
from tests import worlds

RIG, MARKERS, CAR = worlds.qcar_rig_by_hand(), worlds.paper_markers(), worlds.qcar_by_hand()
DRIVER = Navigator(RIG, MARKERS, CAR, worlds.WAYPOINTS_M)
HANDHELD = Navigator(RIG, MARKERS, selector=LowestReprojection())
MATRICES = [name for name, tunable in TUNABLES.items() if tunable.matrix is not None]


def leaf_paths(navigator: Navigator) -> dict[str, np.ndarray]:
    """Every number of a navigator, by the path of its attributes."""
    leaves = jax.tree_util.tree_leaves_with_path(navigator)
    return {jax.tree_util.keystr(path).lstrip("."): np.asarray(leaf) for path, leaf in leaves}


def other_values(navigator: Navigator) -> dict[str, jax.Array]:
    """Numbers of the same shapes, no two alike, and none of them there before."""
    known = parameters_of(navigator)
    return {
        name: (i + 2.0) / 7 + jnp.arange(value.size).reshape(value.shape) / 100
        for i, (name, value) in enumerate(known.items())
    }


def test_a_name_is_the_path_of_its_number():
    found = leaf_paths(DRIVER)
    known = parameters_of(DRIVER)
    assert list(known) == [name for name in TUNABLES if name in found]
    for name, value in known.items():
        np.testing.assert_array_equal(value, found[name])
        assert value.dtype == jnp.float64


def test_every_tunable_is_some_navigator_s():
    turns = TwistBase.create(1.0, 3.0, 0.1, gyro=GYROS["consumer"])
    base = Navigator(RIG, MARKERS, turns, worlds.WAYPOINTS_M)
    led = ConstantVelocity(
        odometry_errors=OdometryErrors.create(default_odometry_sigma(), np.zeros(3))
    )
    carried = Navigator(RIG, MARKERS, motion=led)
    navigators = DRIVER, HANDHELD, base, carried
    names = {name for navigator in navigators for name in parameters_of(navigator)}
    assert names == set(TUNABLES)
    assert not [name for name in parameters_of(HANDHELD) if name.startswith("controller.")]
    assert not [name for name in parameters_of(HANDHELD) if name.startswith("selector.")]
    assert isinstance(HANDHELD.motion, ConstantVelocity)


@pytest.mark.parametrize("navigator", [DRIVER, HANDHELD], ids=["car", "hand-held"])
def test_only_what_is_named_changes(navigator):
    before, values = leaf_paths(navigator), other_values(navigator)
    for name, value in values.items():
        after = leaf_paths(with_parameters(navigator, {name: value}))
        np.testing.assert_array_equal(after.pop(name), value)
        for other, leaf in after.items():
            np.testing.assert_array_equal(leaf, before[other])
    everything = with_parameters(navigator, values)
    for name, value in parameters_of(everything).items():
        np.testing.assert_array_equal(value, values[name])
    assert with_parameters(navigator, {}) is navigator


@pytest.mark.parametrize("motion", [None, BicycleKalman(CAR, gate_nis=5.0), ConstantVelocity()])
def test_an_ungated_rule_is_the_rule_on_a_filter_without_gate(motion):
    """And nothing else of the navigator is another."""
    rule = PaperCost(length_unit_m=0.02)
    gated, ungated = (
        Navigator(RIG, MARKERS, CAR, worlds.WAYPOINTS_M, selector=selector, motion=motion)
        for selector in (rule, Ungated(rule))
    )
    assert jax.tree.structure(ungated) == jax.tree.structure(gated)
    before, after = leaf_paths(gated), leaf_paths(ungated)
    assert np.isfinite(before.pop("motion.gate_nis"))
    assert after.pop("motion.gate_nis") == np.inf
    for name, leaf in before.items():
        np.testing.assert_array_equal(leaf, after[name])


@pytest.mark.parametrize("navigator", [DRIVER, HANDHELD], ids=["car", "hand-held"])
def test_covariances_may_be_matrices_and_vectors_again(navigator):
    for name in MATRICES:
        if name not in parameters_of(navigator):
            continue
        (d,) = parameters_of(navigator)[name].shape
        assert allowed_shapes(name, (d,)) == allowed_shapes(name, (d, d)) == [(d,), (d, d)]
        matrix = 0.5 * jnp.eye(d) + 0.1
        full = with_parameters(navigator, {name: matrix})
        np.testing.assert_array_equal(parameters_of(full)[name], matrix)
        again = with_parameters(full, {name: jnp.ones(d)})
        np.testing.assert_array_equal(parameters_of(again)[name], np.ones(d))


@pytest.mark.parametrize(
    ("values", "told"),
    [
        ({"motion.mass_kg": jnp.ones(())}, r"motion.mass_kg: unknown: expected one of motion\."),
        ({"motion.odometry_sigma": jnp.ones(2)}, r"odometry_sigma: .*\(3,\) or \(3, 3\), got \(2"),
        ({"motion.odometry_sigma": jnp.ones(())}, r"shape \(3,\) or \(3, 3\), got \(\)"),
        ({"motion.odometry_sigma": jnp.ones((3, 2))}, r"got \(3, 2\)"),
        ({"motion.initial_velocity_sigma": jnp.eye(3)}, r"shape \(3,\), got \(3, 3\)"),
        ({"corner_sigma_px": jnp.ones(1)}, r"corner_sigma_px: must have the shape \(\), got \(1,"),
    ],
)
def test_what_does_not_fit_is_named(values, told):
    with pytest.raises(ValueError, match=told):
        with_parameters(DRIVER, values)
    with pytest.raises(ValueError, match=r"controller\.lookahead_m: unknown"):
        with_parameters(HANDHELD, {"controller.lookahead_m": jnp.ones(())})


def test_what_the_paper_does_not_have_takes_effect_where_it_is_told():
    """At infinity, its default, the controller is the paper's (`test_control.py`)."""
    zero = jnp.zeros(())
    state = ControlState(jnp.asarray(0), zero, zero, zero)
    given = ControlInput(jnp.asarray([0.2, -0.5, 0.1]), jnp.asarray(True), zero, zero)
    values = {"controller.lookahead_m": 0.5, "controller.slows_at_rad": 0.3}
    nearer = with_parameters(DRIVER, {name: jnp.asarray(v) for name, v in values.items()})
    (_, one, *_), (_, other, *_) = (
        navigator.controller.towards(state, given) for navigator in (DRIVER, nearer)
    )
    assert other.steering_rad != one.steering_rad
    assert other.throttle < one.throttle
