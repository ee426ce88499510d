"""The bicycle against its differential equations, a twist against the exponential of the group."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.linalg import expm

from jaxnav.core.models import vehicle
from jaxnav.core.models.vehicle import advance_twist
from tests.derivatives import check_derivatives
from tests.reference import paper

WHEELBASE_M = 0.256
velocity_world = jax.jit(vehicle.velocity_world)
advance = jax.jit(vehicle.advance_bicycle)


def arrays(*values):
    return tuple(jnp.asarray(value, float) for value in values)


@pytest.mark.parametrize("steering_rad", [0.0, 1e-9, 0.2, -0.5, 1.2])
@pytest.mark.parametrize("speed_mps", [0.0, 0.7, -0.4])
def test_velocity_is_equations_4_to_7(steering_rad, speed_mps):
    velocity = velocity_world(*arrays(speed_mps, steering_rad, 2.0, WHEELBASE_M))
    expected = paper.velocity(speed_mps, steering_rad, 2.0, WHEELBASE_M)
    np.testing.assert_allclose(velocity, expected, atol=1e-14)


@pytest.mark.parametrize("steering_rad", [0.0, 1e-7, 0.3, -0.5])
@pytest.mark.parametrize("speed_mps", [0.8, -0.5])
def test_advance_is_the_integral(steering_rad, speed_mps, precision):
    start = (1.0, -2.0, 2.9)
    poses = paper.drive(start, speed_mps, steering_rad, 1.5, WHEELBASE_M)
    end = advance(*arrays(start, speed_mps, steering_rad, 1.5, WHEELBASE_M))
    np.testing.assert_allclose(end, poses[-1], atol=3e-6 if precision == np.float32 else 1e-6)


def test_steps_compose():
    """Exact along the arc: two half steps make one."""
    speed, steering, half, whole, wheelbase = arrays(0.6, 0.4, 0.5, 1.0, WHEELBASE_M)
    start = jnp.asarray([0.3, 0.1, -1.0])
    middle = advance(start, speed, steering, half, wheelbase)
    end = advance(middle, speed, steering, half, wheelbase)
    np.testing.assert_allclose(end, advance(start, speed, steering, whole, wheelbase), atol=1e-14)


def test_the_path_is_a_circle_of_radius_R_r():
    """Eq. 5 is the radius of the path of the point midway between the axles."""
    steering = 0.35
    poses = paper.drive((0.0, 0.0, 0.0), 1.0, steering, 1.0, WHEELBASE_M)
    radius = 1 / float(vehicle.curvature_per_m(*arrays(steering, WHEELBASE_M)))
    beta = np.arctan(np.tan(steering) / 2)
    center = radius * np.array([-np.sin(beta), np.cos(beta)])
    np.testing.assert_allclose(np.linalg.norm(poses[:, :2] - center, axis=1), radius, atol=1e-7)
    # The rear axle, half a wheelbase behind, circles the same point at l / tan(steering).
    heading = poses[:, 2:]
    rear = poses[:, :2] - WHEELBASE_M / 2 * np.hstack([np.cos(heading), np.sin(heading)])
    np.testing.assert_allclose(
        np.linalg.norm(rear - center, axis=1), WHEELBASE_M / np.tan(steering), atol=1e-7
    )


@pytest.mark.parametrize("steering_rad", [0.0, 0.4])
def test_derivatives(steering_rad):
    pose = jnp.asarray([0.3, 0.1, -1.0])
    check_derivatives(vehicle.advance_bicycle, pose, *arrays(0.6, steering_rad, 0.5, WHEELBASE_M))
    check_derivatives(vehicle.advance_bicycle, pose, *arrays(0.0, steering_rad, 0.0, WHEELBASE_M))


def test_a_vehicle_from_plain_numbers(precision):
    car = vehicle.Vehicle.create(0.256, 0.5, 0.3, 10.0, 0.3)
    assert car.steering_rate_limit_radps == 5.0
    assert {leaf.dtype for leaf in jax.tree.leaves(car)} == {precision}


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
