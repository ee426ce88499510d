"""The controller of bases that are no cars: they arrive, inside their limits, from anywhere."""

import dataclasses
import functools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from jaxnav.core.control import ControlInput, TwistController
from jaxnav.core.models.vehicle import TwistBase
from jaxnav.core.navigator import Navigator
from jaxnav.sim.plant import BaseState, move_base
from tests import worlds
from tests.core import test_control
from tests.derivatives import check_derivatives

DIFFERENTIAL = TwistBase.create(0.8, 3.0, 0.1)
OMNI = TwistBase.create(0.8, 3.0, 0.1, left_limit_mps=0.3)


def controller(base, waypoints_m=((2.0, 0.0),)) -> TwistController:
    return TwistController.along(jnp.asarray(waypoints_m, float), base, waypoint_radius_m=0.15)


act = functools.partial(test_control.act, steering_rad=np.nan)  # which is not looked at


def of(command) -> np.ndarray:
    return np.array([command.forward_mps, command.left_mps, command.turn_radps])


@eqx.filter_jit
def driven(control, base, poses, decided=True, marker_m=None):
    """The poses (S, 800, 3) of bases that are driven through their waypoints, and whether done."""

    def one(pose):
        def frame(carry, _):
            car, state = carry
            to_marker_m = None
            if marker_m is not None:
                away, psi = marker_m - car.pose[:2], car.pose[2]
                c, s = jnp.cos(psi), jnp.sin(psi)
                to_marker_m = jnp.stack([c * away[0] + s * away[1], c * away[1] - s * away[0]])
            given = ControlInput(
                car.pose, jnp.asarray(True), jnp.zeros(()), jnp.asarray(0.03),
                jnp.asarray(decided), to_marker_m,
            )  # fmt: skip
            state, command, done, _ = control(state, given)
            car = move_base(base, car, command, jnp.asarray(0.03))
            return (car, state), (car.pose, done)

        start = BaseState(pose, jnp.zeros(3)), control.init()
        return jax.lax.scan(frame, start, length=800)[1]

    return jax.vmap(one)(poses)


@pytest.mark.parametrize("base", [DIFFERENTIAL, OMNI], ids=["differential", "omni"])
def test_it_passes_all_waypoints_from_anywhere(base):
    waypoints_m = np.array([(1.0, 0.5), (-0.5, 0.8), (-0.5, -0.9)])
    rng = np.random.default_rng(0)
    starts = np.column_stack([rng.uniform(-2, 2, (40, 2)), rng.uniform(-np.pi, np.pi, 40)])
    poses, done = driven(controller(base, waypoints_m), base, jnp.asarray(starts))
    assert np.all(done[:, -1])
    near = np.linalg.norm(np.asarray(poses)[:, :, None, :2] - waypoints_m, axis=-1) < 0.16
    last = near.shape[1] - near[:, ::-1].argmax(axis=1)
    assert np.all(near.any(axis=1))
    assert np.all(np.diff(last, axis=1) > 0)
    still = np.ptp(np.asarray(poses)[:, -20:], axis=1)
    np.testing.assert_allclose(still, 0, atol=1e-3)
    if base is OMNI:  # it faces as it did
        np.testing.assert_allclose(poses[:, -1, 2], starts[:, 2], atol=1e-9)


def test_ahead_the_arc_leads_through_the_waypoint():
    """The circle through base and waypoint that touches the base's course (Coulter, 1992)."""
    for y_m in (-0.3, 0.0, 0.2):
        _, command, _, log = act(controller(DIFFERENTIAL, [(1.5, y_m)]), (0.0, 0.0, 0.0))
        forward, left, turn = of(command)
        spot = np.cos(np.deg2rad(60.0))
        part = (np.cos(log.alpha_rad) - spot) / (1 - spot)
        on_spot = (1 - part) * 2.0 * log.alpha_rad
        curvature = 2 * y_m / (1.5**2 + y_m**2)
        assert left == 0
        assert (turn - on_spot) / forward == pytest.approx(curvature, abs=1e-9)


@pytest.mark.parametrize("pose", [(0.0, 0.0, np.pi / 2), (0.0, 0.0, -2.5), (3.0, 0.1, 0.0)])
def test_far_to_the_side_it_turns_on_the_spot_to_the_nearer_side(pose):
    _, command, _, log = act(controller(DIFFERENTIAL), pose)
    forward, _, turn = of(command)
    assert forward == 0
    assert np.sign(turn) == np.sign(log.alpha_rad)


@settings(max_examples=100)
@given(st.tuples(*[st.floats(-1e6, 1e6)] * 3), st.booleans(), st.booleans())
def test_no_command_is_beyond_the_limits(pose, decided, omni):
    base = OMNI if omni else DIFFERENTIAL
    looking = {"decided": decided, "to_marker_m": np.array(pose[:2])}
    _, command, _, _ = act(controller(base), pose, **looking)
    assert np.all(np.abs(of(command)) <= np.asarray(base.limits) * (1 + 1e-12))


def test_it_stands_where_nothing_is_known():
    for pose in ((np.nan, 0.0, 0.0), (0.0, 0.0, np.inf), (1e200, 0.0, 0.0)):
        _, command, _, _ = act(controller(DIFFERENTIAL), pose)
        assert np.all(np.isfinite(of(command))), pose
    _, command, _, _ = act(controller(OMNI), (0.0, 0.0, 0.0), located=False)
    np.testing.assert_array_equal(of(command), 0)
    state, command, done, _ = act(controller(OMNI), (2.0, 0.1, 0.0))
    assert done
    np.testing.assert_array_equal(of(command), 0)
    assert int(state.waypoint_index) == 1


@pytest.mark.parametrize("base", [DIFFERENTIAL, OMNI], ids=["differential", "omni"])
def test_exploring_moves_across_the_line_of_sight_and_never_away(base):
    """By a metre across in 3 s, wherever the base looks; inside the circle on which it stood."""
    marker_m = jnp.asarray([0.0, 2.0])
    headings = np.linspace(-np.pi, np.pi, 25)
    starts = np.column_stack([np.zeros((25, 2)), headings])
    control = controller(base)
    poses, done = driven(control, base, jnp.asarray(starts), False, marker_m)
    poses = np.asarray(poses)
    assert not np.any(done)
    away_m = np.linalg.norm(poses[..., :2] - np.asarray(marker_m), axis=-1)
    assert np.all(away_m <= 2.0 + 0.02)
    assert np.all(away_m >= 0.6)
    sight = np.arctan2(2.0 - poses[..., 1], -poses[..., 0])
    across = np.abs(sight[:, 100] - np.pi / 2)
    assert np.all(across > np.deg2rad(25.0 if base is OMNI else 20.0))
    turned = np.abs(poses[:, :30, 2] - headings[:, None]).max()
    assert turned < np.deg2rad(1e-6 if base is OMNI else 75.0)


def test_exploring_ends_and_starts_anew():
    control = controller(DIFFERENTIAL)
    looking = {"decided": False, "to_marker_m": np.array([2.0, 0.0])}
    state, command, _, _ = act(control, (0.0, 0.0, 0.0), **looking)
    assert np.any(of(command) != 0)
    late = dataclasses.replace(state, explored_s=jnp.asarray(13.0))
    _, command, _, _ = act(control, (0.0, 0.0, 0.0), state=late, **looking)
    np.testing.assert_array_equal(of(command), 0)
    state, _, _, _ = act(control, (0.0, 0.0, 0.0), state=late, **looking | {"decided": True})
    assert float(state.explored_s) == 0
    assert float(state.side) == 0


@pytest.mark.parametrize("base", [DIFFERENTIAL, OMNI], ids=["differential", "omni"])
def test_derivatives(base):
    """Also on the waypoint, and where it is straight ahead."""
    control = controller(base)

    def twist(pose):
        true, zero = jnp.asarray(True), jnp.zeros(())
        return control.towards(control.init(), ControlInput(pose, true, zero, zero))[1]

    check_derivatives(twist, jnp.asarray([0.1, 0.3, 0.4]))
    slopes_of = jax.jit(jax.jacrev(twist))
    for x_m in (2.0, 0.0):
        slopes = slopes_of(jnp.asarray([x_m, 0.0, 0.0]))
        assert all(np.all(np.isfinite(leaf)) for leaf in jax.tree.leaves(slopes))


def test_the_navigator_picks_the_controller_by_the_vehicle():
    rig, markers = worlds.qcar_rig(), worlds.paper_markers()
    navigator = Navigator(rig, markers, OMNI, worlds.WAYPOINTS_M, waypoint_radius_m=0.2)
    assert isinstance(navigator.controller, TwistController)
    assert float(navigator.controller.waypoint_radius_m) == 0.2
    assert navigator.motion.vehicle.left_limit_mps == OMNI.left_limit_mps
