"""The paper's control laws: arcs meet their waypoint, integrals stay bounded, and commands stay
inside the limits for any input."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from jaxnav.core.control import ControlInput, Controller, ControlState
from tests import worlds
from tests.derivatives import check_derivatives
from tests.reference import paper

WHEELBASE_M = 0.256
call = eqx.filter_jit(
    lambda controller, state, *args, **named: controller(state, ControlInput(*args, **named))
)


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


def act(control, pose, steering_rad=0.0, dt_s=0.1, state=None, located=True, **looking):
    return call(
        control,
        control.init() if state is None else state,
        jnp.asarray(pose, float),
        jnp.asarray(located),
        jnp.asarray(steering_rad, float),
        jnp.asarray(dt_s, float),
        **{name: jnp.asarray(value) for name, value in looking.items()},
    )


def remembered(waypoint_index: int, integral_ms: float) -> ControlState:
    """A controller that has driven for a while, sure of its pose."""
    zero = jnp.asarray(0.0)
    return ControlState(jnp.asarray(waypoint_index), jnp.asarray(integral_ms), zero, zero)


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
        # The circle of full lock, R_r of Eq. 5, and how far it passes from the waypoint.
        circle_m = WHEELBASE_M / (np.cos(np.arctan(np.tan(0.5) / 2)) * np.tan(0.5))
        passes_m = circle_m - abs(distance * np.exp(1j * abs(alpha)) - 1j * circle_m)
        if passes_m > 0.075:
            assert command.steering_rad == 0
        elif abs(alpha) < np.pi / 2:
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
    waypoint = (pose[0] + distance_m * np.cos(direction), pose[1] + distance_m * np.sin(direction))
    steering = self_consistent_steering(pose, waypoint)
    assert abs(steering) < 0.5
    _, command, _, _ = act(controller([waypoint]), pose, steering)
    assert command.steering_rad == pytest.approx(steering, abs=1e-12)
    path = paper.drive(pose, 1.0, float(command.steering_rad), 2 * distance_m, WHEELBASE_M, 8000)
    misses = np.linalg.norm(path[:, :2] - np.asarray(waypoint), axis=1)
    assert misses.min() < 1e-3


def test_a_waypoint_straight_behind_is_on_the_left_whatever_the_last_bit_says():
    for off_rad in (-1e-9, 0.0, 1e-9):
        _, command, _, log = act(controller([(-2.0, 0.0)]), (0.0, 0.0, off_rad), 0.0)
        assert log.alpha_rad == pytest.approx(np.pi, abs=1e-8)
        assert command.steering_rad == 0.5


def test_repeated_commands_settle_on_that_arc():
    """Each command taken as the next measured angle: a contraction while L_d > l cos(theta)."""
    pose, waypoint = (0.0, 0.0, 0.0), (1.0, 0.6)
    control, steering = controller([waypoint]), 0.0
    for _ in range(40):
        steering = float(act(control, pose, steering)[1].steering_rad)
    assert steering == pytest.approx(self_consistent_steering(pose, waypoint), abs=1e-9)


def driven(control, speed_mps, servo_rad=np.inf):
    """Whether a bicycle arrives within 20 s, and its poses; the servo turns so far in a period."""
    pose, steering, state, poses = np.zeros(3), 0.0, None, []
    for _ in range(200):
        state, command, done, _ = act(control, pose, steering, state=state)
        if done:
            break
        steering += np.clip(float(command.steering_rad) - steering, -servo_rad, servo_rad)
        pose = paper.drive(pose, speed_mps, steering, 0.1, WHEELBASE_M, 20)[-1]
        poses.append(pose)
    return bool(done), np.array(poses)


@pytest.mark.parametrize("direction_deg", [100, 135, 179, -100, -150])
def test_a_waypoint_behind_gets_full_lock_and_is_reached(direction_deg):
    direction = np.deg2rad(direction_deg)
    waypoint = (2 * np.cos(direction), 2 * np.sin(direction))
    control = controller([waypoint])
    _, command, _, _ = act(control, (0.0, 0.0, 0.0))
    assert command.steering_rad == np.sign(direction_deg) * 0.5
    assert driven(control, 0.5)[0]


@pytest.mark.parametrize("side", [-1, 1])
@pytest.mark.parametrize(("distance_m", "direction_deg"), [(0.45, 90), (0.6, 80), (0.4, 120)])
def test_a_waypoint_inside_the_smallest_circle_is_not_orbited(side, distance_m, direction_deg):
    direction = side * np.deg2rad(direction_deg)
    control = controller([(distance_m * np.cos(direction), distance_m * np.sin(direction))])
    _, command, _, _ = act(control, (0.0, 0.0, 0.0))
    assert command.steering_rad == 0
    done, poses = driven(control, 0.4, servo_rad=0.5)  # 5 rad/s
    assert done
    assert np.all(np.linalg.norm(poses[:, :2], axis=1) < 2.0)


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
    state = remembered(1, 2.0)
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


def look_around(
    control, to_marker_m, state=None, pose=(3.0, 0.0, 2.0), decided=False, speed_mps=np.nan, **given
):
    """One call of a car that does not know where it is, and sees a marker from there."""
    looking = {"decided": decided, "to_marker_m": to_marker_m, "speed_mps": speed_mps}
    return act(control, pose, state=state, **given, **looking)


def polar(range_m: float, bearing_deg: float) -> tuple[float, float]:
    bearing = np.deg2rad(bearing_deg)
    return range_m * np.cos(bearing), range_m * np.sin(bearing)


def test_a_decided_car_drives_as_before(precision):
    """Whatever is near, and whatever it did before it knew."""
    control = controller()
    for bearing_deg in (-70, 10, 150):
        state, command, done, log = look_around(control, polar(1.5, bearing_deg), decided=True)
        expected = act(control, (3.0, 0.0, 2.0))
        for leaf, value in zip(
            jax.tree.leaves((state, command, done, log)), jax.tree.leaves(expected), strict=True
        ):
            np.testing.assert_array_equal(leaf, value)
            assert leaf.dtype in (precision, bool, jnp.asarray(0).dtype)


@pytest.mark.parametrize("bearing_deg", [35.0, -35.0, 80.0, -120.0])
def test_an_undecided_car_goes_slowly_at_60_degrees_to_the_line_of_sight(bearing_deg):
    """A bicycle under its commands: to the side it points to already, nearer all the time."""
    control, speed_mps = controller(), 0.3
    explore = control.exploration
    marker = np.array(polar(4.0, bearing_deg))
    pose, steering, state = np.zeros(3), 0.0, None
    ranges, courses_deg = [], []
    for _ in range(60):
        c, s = np.cos(pose[2]), np.sin(pose[2])
        to_marker = np.array([[c, s], [-s, c]]) @ (marker - pose[:2])
        state, command, done, _ = look_around(
            control, to_marker, state, pose, dt_s=0.1, steering_rad=steering
        )
        assert not done
        throttle = explore.speed_mps / float(control.vehicle.speed_per_throttle_mps)
        assert command.throttle == pytest.approx(throttle)
        assert abs(float(command.steering_rad)) <= 0.5
        steering = float(command.steering_rad)
        course = pose[2] + np.arctan(np.tan(steering) / 2)
        sight = np.arctan2(*(marker - pose[:2])[::-1])
        courses_deg.append(np.rad2deg(np.angle(np.exp(1j * (course - sight)))))
        ranges.append(np.hypot(*to_marker))
        pose = paper.drive(pose, speed_mps, steering, 0.1, WHEELBASE_M, 20)[-1]
    # It pointed to the right of a marker on its left.
    side = -np.sign(bearing_deg)
    assert float(state.side) == side
    np.testing.assert_allclose(courses_deg[-20:], side * 60.0, atol=6.0)
    if abs(bearing_deg) < 90:
        assert np.all(np.diff(ranges) < 0)
    else:
        assert np.all(np.diff(ranges[-20:]) < 0)
    assert float(state.explored_s) == pytest.approx(6.0)


def test_the_throttle_leads_where_the_car_lags():
    """With the odometer's speed it is at its exploring speed three times as soon as the motor is
    at its own; open-loop where there is none."""
    control = controller()
    explore, vehicle = control.exploration, control.vehicle
    gain_mps, tau_s = float(vehicle.speed_per_throttle_mps), float(vehicle.speed_time_constant_s)
    assert tau_s == pytest.approx(0.3)
    for known, reached_s in ((True, explore.settle_s), (False, tau_s)):
        speed_mps, times_s, period_s = 0.0, [], 0.01
        for frame in range(200):
            _, command, _, _ = look_around(
                control, polar(2.0, 20.0), speed_mps=speed_mps if known else np.nan
            )
            speed_mps += (gain_mps * float(command.throttle) - speed_mps) * period_s / tau_s
            assert 0 <= command.throttle <= vehicle.throttle_limit
            assert speed_mps <= explore.speed_mps + 1e-9
            if speed_mps >= (1 - np.exp(-1)) * explore.speed_mps:
                times_s.append((frame + 1) * period_s)
        assert times_s[0] == pytest.approx(reached_s, rel=0.2)
        assert speed_mps == pytest.approx(explore.speed_mps, rel=0.01)
    # Too fast, as after a slope: it lets the car roll.
    _, command, _, _ = look_around(control, polar(2.0, 20.0), speed_mps=5.0)
    assert command.throttle == 0


def test_it_keeps_its_side_until_it_knows():
    control = controller()
    state, first, _, _ = look_around(control, polar(2.0, 5.0))
    assert state.side == -1
    state, second, _, _ = look_around(control, polar(2.0, -20.0), state)
    assert state.side == -1
    assert first.steering_rad < 0
    assert second.steering_rad < 0
    state, _, _, _ = look_around(control, polar(2.0, -20.0), state, decided=True)
    assert (state.side, state.explored_s) == (0, 0)
    state, third, _, _ = look_around(control, polar(2.0, -20.0), state)
    assert state.side == 1
    assert third.steering_rad > 0


def test_it_stands_still_too_near_and_after_too_long():
    control = controller()
    nearest_m = control.exploration.min_range_m
    for range_m, goes in ((nearest_m + 0.01, True), (nearest_m - 0.01, False), (0.0, False)):
        _, command, _, _ = look_around(control, polar(range_m, 20.0))
        assert (command.throttle > 0) == goes
        assert np.isfinite(command.steering_rad)
    state, count = None, round(control.exploration.duration_s / 0.5)
    for step in range(count + 3):
        state, command, _, _ = look_around(control, polar(3.0, 20.0), state, dt_s=0.5)
        assert (command.throttle > 0) == (step < count)
    # Once it has known in between it may look around anew.
    state, _, _, _ = look_around(control, polar(3.0, 20.0), state, decided=True)
    state, command, _, _ = look_around(control, polar(3.0, 20.0), state)
    assert command.throttle > 0


def test_no_waypoint_is_reached_and_nothing_summed_up_while_undecided():
    control, waypoint = controller(), (*worlds.WAYPOINTS_M[0], 0.0)
    state = remembered(0, 1.5)
    for _ in range(5):
        state, _, done, _ = look_around(control, polar(2.0, 20.0), state, waypoint)
        assert int(state.waypoint_index) == 0
        assert state.integral_ms == 1.5
        assert not done
    state, _, _, _ = look_around(control, polar(2.0, 20.0), state, waypoint, decided=True)
    assert int(state.waypoint_index) == 1
    last = (*worlds.WAYPOINTS_M[1], 0.0)
    state, command, done, _ = look_around(control, polar(2.0, 20.0), state, last, decided=True)
    assert done
    # What is over stays over.
    state, command, done, _ = look_around(control, polar(2.0, 20.0), state, last)
    assert done
    assert (command.steering_rad, command.throttle) == (0, 0)


def test_it_explores_only_where_it_sees_a_marker():
    """Before the first pose, and without a marker to look at, it stands."""
    control = controller()
    _, command, _, _ = look_around(control, polar(2.0, 20.0), located=False)
    assert (command.steering_rad, command.throttle) == (0, 0)
    zero = jnp.asarray(0.0)
    _, command, _, _ = call(
        control, control.init(), jnp.asarray([3.0, 0.0, 2.0]), jnp.asarray(True), zero,
        jnp.asarray(0.1), jnp.asarray(False),
    )  # fmt: skip
    assert (command.steering_rad, command.throttle) == (0, 0)


def test_exploring_has_finite_gradients():
    control = controller()

    @jax.jit
    @jax.grad
    def slope(floats):
        pose, to_marker_m, steering_rad, dt_s, speed_mps = floats
        given = ControlInput(
            pose, jnp.asarray(True), steering_rad, dt_s, jnp.asarray(False), to_marker_m, speed_mps
        )
        state, command, _, _ = control(control.init(), given)
        return command.steering_rad + command.throttle + state.explored_s

    for to_marker in (polar(2.0, 20.0), (0.0, 0.0), (-1.0, 0.0)):
        for speed_mps in (0.4, np.nan):
            numbers = jnp.asarray([0.1, 0.1, speed_mps])
            floats = (jnp.asarray([3.0, 0, 2]), jnp.asarray(to_marker, float), *numbers)
            assert all(np.all(np.isfinite(leaf)) for leaf in slope(floats))


ANYTHING = st.floats(allow_nan=True, allow_infinity=True)
WHATEVER = controller()


@settings(max_examples=300)
@given(*[ANYTHING] * 6)
@example(np.nan, 0.0, 0.0, 0.0, 0.1, 0.0)
@example(0.0, 0.0, np.inf, 0.0, 0.1, 0.0)
@example(1e300, 0.0, 0.0, 0.0, 0.0, 0.0)
@example(0.0, 0.0, 0.0, np.nan, -np.inf, 0.0)
@example(0.0, 0.0, 5.36e278, 0.0, 0.0, 0.0)
@example(1.3, 0.0, 0.0, np.pi / 2, 0.1, 0.0)
def test_limits_hold_for_any_input(x_m, y_m, psi_rad, steering_rad, dt_s, integral_ms):
    integral_ms = integral_ms if 0 <= integral_ms <= 5 else 0.0
    state = remembered(0, integral_ms)
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
        given = ControlInput(pose, located, steering_rad, dt_s)
        state, command, _, _ = eqx.combine(floats, control)(control.init(), given)
        return command.steering_rad, command.throttle, state.integral_ms

    pose = jnp.asarray([2.5, -0.5, 2.3])
    check_derivatives(outcome, pose, jnp.asarray(0.2), control, atol=1e-7)
    # On top of the waypoint, and with it exactly behind.
    slopes_of = jax.jit(jax.jacrev(outcome, (0, 1)))
    for where in ((1.3, 0.0, 0.4), (2.3, 0.0, 0.0)):
        slopes = slopes_of(jnp.asarray(where), jnp.asarray(0.0), control)
        assert all(np.all(np.isfinite(leaf)) for leaf in jax.tree.leaves(slopes))
