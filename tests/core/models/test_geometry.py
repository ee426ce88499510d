"""Planar poses, rotations and guarded functions against SciPy and finite differences."""

import functools

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.linalg import expm
from scipy.spatial.transform import Rotation

from jaxnav.core.models import geometry as plain
from tests.derivatives import check_derivatives
from tests.helpers.compiling import jitted
from tests.reference.rigid import cayley, inverse_cayley, matrix, twist_matrix, wxyz_xyz
from tests.worlds import planar

ANGLES = st.floats(-1e4, 1e4)
geometry = jitted(plain)


@settings(max_examples=200)
@given(ANGLES)
def test_wrapping_keeps_the_direction(angle_rad):
    wrapped = float(geometry.wrap_angle(jnp.asarray(angle_rad)))
    assert -np.pi - 1e-11 <= wrapped <= np.pi
    assert np.cos(wrapped) == pytest.approx(np.cos(angle_rad), abs=1e-11)
    assert np.sin(wrapped) == pytest.approx(np.sin(angle_rad), abs=1e-11)


def test_wrapping_at_the_seam():
    angles = jnp.asarray([-np.pi, np.pi, 3 * np.pi - 0.1, 0.0])
    np.testing.assert_allclose(
        geometry.wrap_angle(angles), [-np.pi, -np.pi, np.pi - 0.1, 0.0], atol=1e-14
    )
    slopes = jax.jit(jax.vmap(jax.grad(geometry.wrap_angle)))(angles)
    np.testing.assert_array_equal(slopes, 1)


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_wrapping_in_numpy_is_the_same(dtype):
    angles = np.append(np.linspace(-20, 20, 101), [-np.pi, np.pi, np.nan]).astype(dtype)
    wrapped = plain.wrap_angle_np(angles)
    assert wrapped.dtype == dtype
    expected = geometry.wrap_angle(jnp.asarray(angles))
    np.testing.assert_allclose(wrapped, expected, atol=20 * np.finfo(dtype).eps)


def test_planar_pose_is_a_turn_about_z(precision):
    tolerance = 1e-6 if precision == np.float32 else 1e-14
    for pose in [(0.0, 0.0, 0.0), (1.0, -2.0, 3.1), (-4.0, 0.5, -3.1), (0.1, 0.2, np.pi / 2)]:
        T_world_vehicle = planar(*pose)
        expected = np.eye(4)
        expected[:2, 3] = pose[:2]
        expected[:3, :3] = Rotation.from_rotvec([0, 0, pose[2]]).as_matrix()
        assert T_world_vehicle.wxyz_xyz.dtype == precision
        np.testing.assert_allclose(matrix(T_world_vehicle.wxyz_xyz), expected, atol=tolerance)
        back = geometry.planar_from_T_world_vehicle(T_world_vehicle)
        np.testing.assert_allclose(back, pose, atol=5 * tolerance)


def test_planar_poses_and_points_over_batches():
    rng = np.random.default_rng(0)
    T_a_b = jaxlie.SE3(jnp.asarray(wxyz_xyz(cayley(rng.normal(size=6)))))
    R, t = matrix(T_a_b.wxyz_xyz)[:3, :3], np.asarray(T_a_b.wxyz_xyz)[4:]
    for batch in ((), (3, 1, 2)):
        poses = jnp.asarray(rng.uniform(-3, 3, (*batch, 3)))
        lifted = geometry.T_world_vehicle_from_planar(poses)
        assert lifted.wxyz_xyz.shape == (*batch, 7)
        back = geometry.planar_from_T_world_vehicle(lifted)
        np.testing.assert_allclose(back, poses, atol=1e-13)
        points_a = geometry.transform_points(T_a_b, poses)
        np.testing.assert_allclose(points_a, np.asarray(poses) @ R.T + t, atol=1e-13)


def test_heading_of_a_tilted_body_is_that_of_its_x_axis():
    turns = Rotation.random(200, rng=1)
    x_axis = turns.as_matrix()[:, :, 0]
    wxyz = np.roll(turns.as_quat(), 1, axis=1)
    T_world_vehicle = jaxlie.SE3(jnp.asarray(np.hstack([wxyz, np.ones((200, 3))])))
    heading = geometry.planar_from_T_world_vehicle(T_world_vehicle)[:, 2]
    np.testing.assert_allclose(heading, np.arctan2(x_axis[:, 1], x_axis[:, 0]), atol=1e-9)


def test_heading_of_a_vertical_body_is_zero_with_zero_slope():
    upwards = jaxlie.SE3(jnp.asarray([0.5**0.5, 0.0, -(0.5**0.5), 0.0, 0.0, 0.0, 0.0]))

    def heading(wxyz_xyz):
        return geometry.planar_from_T_world_vehicle(jaxlie.SE3(wxyz_xyz))[2]

    assert np.isfinite(heading(upwards.wxyz_xyz))
    assert np.all(np.isfinite(jax.jit(jax.grad(heading))(upwards.wxyz_xyz)))


def test_planar_covariance_is_the_jacobian_s():
    root, step = np.random.default_rng(2).normal(size=(6, 6)), 1e-6

    @jax.jit
    @functools.partial(jax.vmap, in_axes=(None, 0))
    def planar_of(T_world_vehicle, xi):
        return plain.planar_from_T_world_vehicle(T_world_vehicle @ jaxlie.SE3.exp(xi))

    for rotvec in ((0.0, 0.0, 0.0), (0.0, 0.0, 2.5), (0.3, -0.4, 1.2)):
        wxyz = np.roll(Rotation.from_rotvec(rotvec).as_quat(), 1)
        T_world_vehicle = jaxlie.SE3(jnp.asarray(np.append(wxyz, [1.0, 2.0, 3.0])))
        ahead, behind = (planar_of(T_world_vehicle, sign * step * np.eye(6)) for sign in (1, -1))
        J = np.asarray(ahead - behind).T / (2 * step)
        result = geometry.planar_covariance(T_world_vehicle, jnp.asarray(root @ root.T))
        np.testing.assert_allclose(result, J @ root @ root.T @ J.T, rtol=1e-8, atol=1e-8)


def test_guarded_functions_at_their_singularity(precision):
    zero = jnp.zeros((), precision)
    for function, arguments in (
        (plain.safe_sqrt, (zero,)),
        (plain.safe_sqrt, (jnp.asarray(-1.0, precision),)),
        (plain.safe_norm, (jnp.zeros(3),)),
        (plain.safe_atan2, (zero, zero)),
    ):
        told = jax.jit(jax.value_and_grad(function, tuple(range(len(arguments)))))(*arguments)
        for leaf in jax.tree.leaves(told):
            np.testing.assert_array_equal(leaf, 0)


def test_guarded_functions_elsewhere_are_the_plain_ones():
    values = np.random.default_rng(3).normal(size=(50, 2))
    x, y = jnp.asarray(values.T)
    np.testing.assert_allclose(geometry.safe_atan2(y, x), np.arctan2(y, x))
    np.testing.assert_allclose(geometry.safe_norm(jnp.asarray(values)), np.hypot(x, y))
    np.testing.assert_allclose(geometry.safe_sqrt(x**2), np.abs(x))
    check_derivatives(geometry.safe_atan2, y, x)
    check_derivatives(geometry.safe_norm, jnp.asarray(values))


def test_sinc_and_its_slope_keep_their_digits(precision):
    """Against the integrals of cos(a t) and -t sin(a t) over t from 0 to 1, in which nothing
    cancels: from where squares underflow to where the sine has turned often."""
    angles = np.geomspace(1e-37, 20.0, 200).astype(precision)
    angles = np.concatenate([-angles, np.zeros(1, precision), angles])
    values, slopes = jax.jit(jax.vmap(jax.value_and_grad(plain.safe_sinc)))(angles)
    assert values.dtype == precision
    nodes, weights = np.polynomial.legendre.leggauss(100)
    t, turned = (nodes + 1) / 2, np.outer(angles.astype(float), (nodes + 1) / 2)
    near = {"rtol": 0, "atol": 8 * np.finfo(precision).eps}
    np.testing.assert_allclose(values, np.cos(turned) @ weights / 2, **near)
    np.testing.assert_allclose(slopes, -(t * np.sin(turned)) @ weights / 2, **near)


def test_guarded_functions_do_not_hide_what_is_no_number():
    nan = jnp.asarray(jnp.nan)
    assert np.isnan(geometry.safe_sqrt(nan))
    assert np.isnan(geometry.safe_norm(jnp.asarray([1.0, np.nan])))
    assert np.isnan(geometry.safe_atan2(nan, jnp.asarray(1.0)))


def half_turns() -> np.ndarray:
    axes = np.random.default_rng(4).normal(size=(300, 3))
    axes = np.concatenate([axes, np.eye(3), -np.eye(3), [[1, 1, 0], [0, 1, -1]]])
    axes /= np.linalg.norm(axes, axis=1, keepdims=True)
    return 2 * axes[:, :, None] * axes[:, None] - np.eye(3)


read_rotations = jax.jit(jax.vmap(geometry.rotation_from_matrix))


@pytest.mark.parametrize("near", [False, True])
def test_rotation_is_read_off_any_matrix(precision, near):
    rng = np.random.default_rng(5)
    matrices = np.concatenate([Rotation.random(700, rng=5).as_matrix(), half_turns(), [np.eye(3)]])
    if near:  # almost a half turn, on either side
        matrices = (
            matrices @ Rotation.from_rotvec(rng.normal(0, 1e-9, (len(matrices), 3))).as_matrix()
        )
    rotations = read_rotations(jnp.asarray(matrices, precision))
    tolerance = 1e-6 if precision == np.float32 else 1e-14
    found = Rotation.from_quat(np.roll(rotations.wxyz, -1, axis=1)).as_matrix()
    np.testing.assert_allclose(found, matrices, atol=tolerance)
    np.testing.assert_allclose(np.linalg.norm(rotations.wxyz, axis=1), 1, atol=tolerance)


def test_no_rounding_chooses_the_sign_of_a_quaternion():
    """Half turns about an axis between two of the frame's have two formulas that are as good."""
    rng = np.random.default_rng(5)
    exact = half_turns()
    first = read_rotations(jnp.asarray(exact)).wxyz
    for _ in range(5):
        turned = exact @ Rotation.from_rotvec(rng.normal(0, 1e-9, (len(exact), 3))).as_matrix()
        np.testing.assert_allclose(read_rotations(jnp.asarray(turned)).wxyz, first, atol=1e-8)


def test_reading_a_rotation_has_finite_slopes_equal_to_differences():
    jacobian = jax.jit(jax.vmap(jax.jacrev(lambda R: geometry.rotation_from_matrix(R).wxyz)))
    assert np.all(np.isfinite(jacobian(jnp.asarray([np.eye(3), *half_turns()]))))
    generic = jnp.asarray(Rotation.random(10, rng=7).as_matrix())
    check_derivatives(jax.vmap(lambda R: geometry.rotation_from_matrix(R).wxyz), generic)


def test_the_angle_of_a_turn():
    rng, still = np.random.default_rng(7), jaxlie.SE3(jnp.asarray([1.0, 0, 0, 0, 0, 0, 0]))
    for angle in (0.0, 1e-9, 0.3, 3.0, np.pi):
        axis = rng.normal(size=3)
        wxyz = np.roll(Rotation.from_rotvec(angle * axis / np.linalg.norm(axis)).as_quat(), 1)
        for sign in (1, -1):
            T = jaxlie.SE3(jnp.asarray(np.append(sign * wxyz, rng.normal(size=3))))
            assert geometry.rotation_error_rad(still, T) == pytest.approx(angle, abs=1e-12)


def turning(turn_rad: float, seed: int) -> np.ndarray:
    rng = np.random.default_rng(seed)
    axis = rng.normal(size=3)
    return np.append(rng.normal(size=3), turn_rad * axis / np.linalg.norm(axis))


def test_cayley_is_the_rational_motion_of_a_twist(precision):
    tolerance = 1e-5 if precision == np.float32 else 1e-12
    for turn_rad in (0.0, 1e-4, 0.3, 2.0):
        xi = turning(turn_rad, 0)
        T = geometry.cayley(jnp.asarray(xi, precision))
        np.testing.assert_allclose(matrix(T.wxyz_xyz), cayley(xi), atol=tolerance)
        np.testing.assert_allclose(inverse_cayley(cayley(xi)), xi, atol=1e-12)
        np.testing.assert_allclose(geometry.inverse_cayley(T), xi, atol=10 * tolerance)
        R = geometry.rotation_matrix(T.rotation())
        np.testing.assert_allclose(R, cayley(xi)[:3, :3], atol=tolerance)
        close = np.linalg.norm(0.1 * xi) ** 3 / 10 + tolerance
        np.testing.assert_allclose(cayley(0.1 * xi), expm(twist_matrix(0.1 * xi)), atol=close)


def test_the_jacobian_of_cayley_is_that_of_differences():
    step = 1e-6
    for turn_rad in (0.0, 0.3, 2.0):
        xi = turning(turn_rad, 1)
        J = np.asarray(geometry.cayley_jacobian(jnp.asarray(xi)))
        for k, d in enumerate(step * np.eye(6)):
            local = np.linalg.inv(cayley(xi)) @ (cayley(xi + d) - cayley(xi - d)) / (2 * step)
            np.testing.assert_allclose(local, twist_matrix(J[:, k]), atol=1e-8)
        back = geometry.inverse_cayley_jacobian(jnp.asarray(xi))
        np.testing.assert_allclose(back @ J, np.eye(6), atol=1e-12)


def test_a_half_turn_has_a_finite_twist_and_gradient():
    T = jaxlie.SE3(jnp.asarray([0.0, 0.6, 0.0, 0.8, 1.0, 2.0, 3.0]))
    assert np.all(np.isfinite(geometry.inverse_cayley(T)))
    jacobian = jax.jit(jax.jacfwd(lambda x: plain.inverse_cayley(jaxlie.SE3(x))))
    assert np.all(np.isfinite(jacobian(T.wxyz_xyz)))
    xi = geometry.inverse_cayley(planar(0.0, 0.0, np.deg2rad(169.0)))
    np.testing.assert_allclose(xi[5], 2 * np.tan(np.deg2rad(169.0) / 2), rtol=1e-9)
