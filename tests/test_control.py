"""The paper's control laws: arcs that meet their waypoint, sums that stay bounded, commands that
stay inside the limits whatever comes in."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from jaxnav.control import Controller, ControlState
from tests import worlds
from tests.derivatives import check_derivatives
from tests.reference import paper

WHEELBASE_M = 0.256
call = eqx.filter_jit(lambda controller, *args: controller(*args))


def controller(waypoints_m=worlds.WAYPOINTS_M, **changes) -> Controller:
    return Controller(
        waypoints_m=jnp.asarray(waypoints_m, float),
        vehicle=worlds.qcar(),
        **{
            key: jnp.asarray(changes.get(key, default), float)
            for key, default in {
                "waypoint_radius_m": 0.15,
                "proportional_per_m": 0.05,
                "integral_per_ms": 0.01,
                "integral_limit_ms": 5.0,
            }.items()
        },
    )


def act(control, pose, steering_rad=0.0, dt_s=0.1, state=None, located=True):
    return call(
        control,
        control.init() if state is None else state,
        jnp.asarray(pose, float),
        jnp.asarray(located),
        jnp.asarray(steering_rad, float),
        jnp.asarray(dt_s, float),
    )


def test_steering_is_equations_16_to_18(precision):
    rng = np.random.default_rng(0)
    rtol = 2e-5 if precision == np.float32 else 1e-12
    control = controller()
    for _ in range(50):
        pose = (*rng.uniform(-3, 3, 2), rng.uniform(-np.pi, np.pi))
        measured = rng.uniform(-0.5, 0.5)
        _, command, _, log = act(control, pose, measured)
        angle, distance, alpha = paper.steering(pose, worlds.WAYPOINTS_M[0], measured, WHEELBASE_M)
        np.testing.assert_allclose(log.distance_m, distance, rtol=rtol)
        np.testing.assert_allclose(log.alpha_rad, alpha, rtol=rtol, atol=2e-6)
        if abs(alpha) < np.pi / 2:
            np.testing.assert_allclose(
                command.steering_rad, np.clip(angle, -0.5, 0.5), rtol=rtol, atol=1e-6
            )


def self_consistent_steering(pose, waypoint_m):
    """The angle that Eq. 18 gives back when the wheels stand at it already.

    With theta the direction of the waypoint from the heading and tan(beta) = tan(delta) / 2,
    Eq. 18 becomes tan(beta) (L_d + l cos(theta)) = l sin(theta).
    """
    dx, dy = waypoint_m[0] - pose[0], waypoint_m[1] - pose[1]
    theta = np.arctan2(dy, dx) - pose[2]
    tan_beta = WHEELBASE_M * np.sin(theta) / (np.hypot(dx, dy) + WHEELBASE_M * np.cos(theta))
    return np.arctan(2 * tan_beta)


@pytest.mark.parametrize("direction_deg", [-60, -20, 0, 5, 45, 70])
@pytest.mark.parametrize("distance_m", [0.8, 2.0])
def test_the_arc_meets_the_waypoint(direction_deg, distance_m):
    """Eqs. 16-18 are exact once beta is that of the commanded angle: the path of a bicycle that
    holds it leads within 1 mm of the waypoint."""
    heading = 2.9
    pose = (0.3, -0.2, heading)
    direction = heading + np.deg2rad(direction_deg)
    waypoint = (
        pose[0] + distance_m * np.cos(direction),
        pose[1] + distance_m * np.sin(direction),
    )
    steering = self_consistent_steering(pose, waypoint)
    assert abs(steering) < 0.5
    _, command, _, _ = act(controller([waypoint]), pose, steering)
    assert command.steering_rad == pytest.approx(steering, abs=1e-12)
    path = paper.drive(pose, 1.0, float(command.steering_rad), 2 * distance_m, WHEELBASE_M, 8000)
    misses = np.linalg.norm(path[:, :2] - np.asarray(waypoint), axis=1)
    assert misses.min() < 1e-3


def test_repeated_commands_settle_on_that_arc():
    """Each command taken as the next measured angle: a contraction while L_d > l cos(theta)."""
    pose, waypoint = (0.0, 0.0, 0.0), (1.0, 0.6)
    control, steering = controller([waypoint]), 0.0
    for _ in range(40):
        steering = float(act(control, pose, steering)[1].steering_rad)
    assert steering == pytest.approx(self_consistent_steering(pose, waypoint), abs=1e-9)


@pytest.mark.parametrize("direction_deg", [100, 135, 179, -100, -150])
def test_a_waypoint_behind_gets_full_lock_and_is_reached(direction_deg):
    direction = np.deg2rad(direction_deg)
    waypoint = (2 * np.cos(direction), 2 * np.sin(direction))
    control = controller([waypoint])
    _, command, _, _ = act(control, (0.0, 0.0, 0.0))
    assert command.steering_rad == np.sign(direction_deg) * 0.5
    pose, steering, state = np.zeros(3), 0.0, None
    for _ in range(200):
        state, command, done, _ = act(control, pose, steering, state=state)
        if done:
            break
        steering = float(command.steering_rad)
        pose = paper.drive(pose, 0.5, steering, 0.1, WHEELBASE_M, 20)[-1]
    assert done


def test_throttle_is_equation_19():
    control, state, total = controller(), None, 0.0
    for step, x_m in enumerate((3.0, 2.9, 2.8, 2.6)):
        state, command, _, log = act(
            control, (x_m, 0.0, np.pi), dt_s=0.1 + 0.01 * step, state=state
        )
        total += (x_m - 1.30) * (0.1 + 0.01 * step)
        assert log.integral_ms == pytest.approx(total, rel=1e-12)
        assert command.throttle == pytest.approx(0.05 * (x_m - 1.30) + 0.01 * total, rel=1e-12)


def test_the_sum_does_not_wind_up_and_starts_anew_at_every_waypoint():
    control, state = controller(), None
    for _ in range(500):
        state, command, _, _ = act(control, (2.8, 0.0, 0.0), state=state)
    assert state.integral_ms == 5.0
    assert command.throttle == pytest.approx(0.05 * 1.5 + 0.01 * 5)
    state, command, done, log = act(control, (1.35, 0.0, 2.0), state=state)
    assert int(state.waypoint_index) == 1
    assert not done
    to_second_m = np.hypot(1.35 - 0.5, 0.65)
    assert log.distance_m == pytest.approx(to_second_m)
    assert log.integral_ms == pytest.approx(0.1 * to_second_m)


def test_it_stops_at_the_last_waypoint_for_good():
    control = controller()
    state = ControlState(jnp.asarray(1), jnp.asarray(2.0))
    state, command, done, _ = act(control, (0.5, 0.6, 1.0), state=state)
    assert done
    assert (command.steering_rad, command.throttle) == (0, 0)
    assert int(state.waypoint_index) == 2
    for pose in ((0.5, 0.65, 0.0), (5.0, 5.0, 0.0), (1.30, 0.0, 0.0)):
        state, command, done, _ = act(control, pose, state=state)
        assert done
        assert (command.steering_rad, command.throttle, state.integral_ms) == (0, 0, 0)
        assert int(state.waypoint_index) == 2


def test_it_waits_until_it_is_located():
    state, command, done, _ = act(controller(), (1.30, 0.0, 0.0), located=False)
    assert (command.steering_rad, command.throttle, state.integral_ms) == (0, 0, 0)
    assert int(state.waypoint_index) == 0
    assert not done


ANYTHING = st.floats(allow_nan=True, allow_infinity=True)
WHATEVER = controller()


@settings(max_examples=300, deadline=None)
@given(*[ANYTHING] * 6)
@example(np.nan, 0.0, 0.0, 0.0, 0.1, 0.0)
@example(0.0, 0.0, np.inf, 0.0, 0.1, 0.0)
@example(1e300, 0.0, 0.0, 0.0, 0.0, 0.0)
@example(0.0, 0.0, 0.0, np.nan, -np.inf, 0.0)
@example(1.3, 0.0, 0.0, np.pi / 2, 0.1, 0.0)
def test_limits_hold_for_any_input(x_m, y_m, psi_rad, steering_rad, dt_s, integral_ms):
    integral_ms = integral_ms if 0 <= integral_ms <= 5 else 0.0
    state = ControlState(jnp.asarray(0), jnp.asarray(integral_ms))
    state, command, _, _ = act(WHATEVER, (x_m, y_m, psi_rad), steering_rad, dt_s, state)
    assert abs(float(command.steering_rad)) <= 0.5
    assert abs(float(command.throttle)) <= 0.3
    assert 0 <= float(state.integral_ms) <= 5
    if not np.all(np.isfinite([x_m, y_m, psi_rad])):
        assert (command.steering_rad, command.throttle) == (0, 0)
        assert int(state.waypoint_index) == 0


def test_derivatives():
    """Of the command and the sum, with respect to pose, gains and route."""
    control = controller()
    located, dt_s = jnp.asarray(True), jnp.asarray(0.1)

    def outcome(pose, steering_rad, floats):
        state, command, _, _ = eqx.combine(floats, control)(
            control.init(), pose, located, steering_rad, dt_s
        )
        return command.steering_rad, command.throttle, state.integral_ms

    pose = jnp.asarray([2.5, -0.5, 2.3])
    check_derivatives(outcome, pose, jnp.asarray(0.2), control, atol=1e-7)
    # On top of the waypoint, and with it exactly behind.
    for where in ((1.3, 0.0, 0.4), (2.3, 0.0, 0.0)):
        slopes = jax.jit(jax.jacrev(outcome, (0, 1)))(jnp.asarray(where), jnp.asarray(0.0), control)
        assert all(np.all(np.isfinite(leaf)) for leaf in jax.tree.leaves(slopes))
