"""e1 and e2 against loops written straight from the paper's equations, and closed-form derivatives
against differentiated projections."""

import dataclasses

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from jaxnav.core.models.camera import Camera
from jaxnav.core.models.rig import CameraRig
from jaxnav.core.pose.observation import Sightings, cameras_of
from jaxnav.core.pose.residuals import (
    cross_product,
    e1,
    e2,
    pinhole_rows,
    reprojection_rows,
    turn_arms,
)
from tests import worlds
from tests.core.models.test_camera import MODELS
from tests.derivatives import check_derivatives
from tests.reference import paper
from tests.reference.rigid import cayley, matrix, wxyz_xyz

VIEW = (0.2, 0.1, 0.6)
image_error = jax.jit(e1)
space_error = jax.jit(e2)


def reference_e1(rig, markers, corners_px, visible, T_vehicle_world):
    cameras = [rig.camera(index) for index in range(len(rig))]
    return paper.e1(
        [(np.asarray(c.K), c.lenses[int(c.lens_index)], np.asarray(c.distortion)) for c in cameras],
        matrix(rig.Ts_camera_vehicle.wxyz_xyz),
        np.asarray(markers.corners_world_m),
        np.asarray(corners_px),
        np.asarray(visible),
        matrix(T_vehicle_world.wxyz_xyz),
    )


@pytest.fixture(scope="module", params=["car", "hand-held"])
def world(request):
    """A rig, markers, a noisy view of them, and a pose near the true one."""
    rig = worlds.qcar_rig() if request.param == "car" else worlds.handheld_rig()
    markers = worlds.room_markers()
    T_world_vehicle = matrix(worlds.planar(*VIEW).wxyz_xyz)
    if request.param == "hand-held":  # its y axis points down
        T_world_vehicle[:3, :3] @= [[1, 0, 0], [0, 0, 1], [0, -1, 0]]
    rng = np.random.default_rng(0)
    noise = jnp.asarray(rng.normal(size=(4, 4, 4, 2)))
    obs = worlds.observe(rig, markers, pose_of(T_world_vehicle), noise)
    assert np.sum(obs.visible) >= 5
    near = np.linalg.inv(T_world_vehicle @ cayley(rng.normal(0, 0.03, 6)))
    return rig, markers, obs, pose_of(near)


def pose_of(T: np.ndarray) -> jaxlie.SE3:
    return jaxlie.SE3(jnp.asarray(wxyz_xyz(T)))


def test_e1_is_equation_3(world):
    rig, markers, obs, T_vehicle_world = world
    value = image_error(rig, markers, obs.corners_px, obs.visible, T_vehicle_world)
    expected = reference_e1(rig, markers, obs.corners_px, obs.visible, T_vehicle_world)
    assert expected > 100
    np.testing.assert_allclose(value, expected, rtol=1e-11)


def test_hidden_lanes_add_nothing(world):
    rig, markers, obs, T_vehicle_world = world
    clean = image_error(rig, markers, obs.corners_px, obs.visible, T_vehicle_world)
    filled = np.where(np.asarray(obs.visible)[:, :, None, None], obs.corners_px, np.nan)
    filled = jnp.asarray(filled)
    assert image_error(rig, markers, filled, obs.visible, T_vehicle_world) == clean
    nothing = jnp.asarray(np.zeros((4, 4), bool))
    assert image_error(rig, markers, filled, nothing, T_vehicle_world) == 0


def test_e2_is_equation_14(world):
    _, markers, obs, T_vehicle_world = world
    near = matrix(T_vehicle_world.wxyz_xyz) @ cayley(np.array([0.1, -0.2, 0.05, 0.1, 0.2, -0.3]))
    prior = pose_of(near)
    in_view = np.any(np.asarray(obs.visible), axis=0)
    in_view[0] = False
    visible = obs.visible & jnp.asarray(in_view)[None]
    value = space_error(markers, visible, T_vehicle_world, prior)
    matrices = (matrix(T.wxyz_xyz) for T in (T_vehicle_world, prior))
    expected = paper.e2(np.asarray(markers.corners_world_m), in_view, *matrices)
    assert expected > 0.01
    np.testing.assert_allclose(value, expected, rtol=1e-11)


def test_a_marker_seen_by_two_cameras_counts_once_in_e2_and_twice_in_e1():
    rig, markers = worlds.qcar_rig(), worlds.paper_markers()
    T_world_vehicle = worlds.planar(*worlds.OVERLAP_VIEW)
    obs = worlds.observe(rig, markers, T_world_vehicle)
    both, one, other = np.array(obs.visible), np.array(obs.visible), np.array(obs.visible)
    assert np.sum(both) == 2
    one[3] = other[0] = False
    there = matrix(T_world_vehicle.wxyz_xyz)
    T = pose_of(np.linalg.inv(there @ cayley(np.full(6, 0.01))))
    prior = pose_of(np.linalg.inv(there))
    spaces = [float(space_error(markers, v, T, prior)) for v in (both, one, other)]
    assert spaces[0] == spaces[1] == spaces[2] > 0
    images = [float(image_error(rig, markers, obs.corners_px, v, T)) for v in (both, one, other)]
    assert images[0] == pytest.approx(images[1] + images[2], rel=1e-12)
    assert min(images) > 0


@pytest.mark.parametrize("world", ["hand-held"], indirect=True)
def test_derivatives_of_e1(world):
    rig, markers, obs, T_vehicle_world = world

    def moved(xi, extrinsic_xi, corners_px):
        Ts = jax.vmap(lambda T, x: T @ jaxlie.SE3.exp(x))(rig.Ts_camera_vehicle, extrinsic_xi)
        changed = CameraRig(rig.cameras, Ts, rig.names, rig.image_sizes_px)
        return e1(changed, markers, corners_px, obs.visible, T_vehicle_world @ jaxlie.SE3.exp(xi))

    arguments = (jnp.zeros(6), jnp.zeros((4, 6)), obs.corners_px)
    check_derivatives(moved, *arguments, step=1e-6, rtol=1e-6, atol=1e-3)
    by_corner = jax.jit(jax.grad(moved, 2))(*arguments)
    assert np.all(by_corner[~np.asarray(obs.visible)] == 0)
    assert np.all(by_corner[np.asarray(obs.visible)] != 0)


@pytest.mark.parametrize("world", ["hand-held"], indirect=True)
def test_derivatives_of_e2(world):
    _, markers, obs, T_vehicle_world = world

    def moved(xi, xi_prior):
        return e2(
            markers,
            obs.visible,
            T_vehicle_world @ jaxlie.SE3.exp(xi),
            T_vehicle_world @ jaxlie.SE3.exp(xi_prior),
        )

    check_derivatives(moved, jnp.zeros(6), jnp.full(6, 0.1))
    # At the prior itself e2 is at its minimum, zero.
    gradient = jax.jit(jax.grad(moved))(jnp.zeros(6), jnp.zeros(6))
    np.testing.assert_allclose(gradient, 0, atol=1e-12)


def test_e1_is_finite_with_the_marker_behind_every_pinhole(precision):
    markers = worlds.paper_markers()
    rig = worlds.qcar_rig()
    obs = worlds.observe(rig, markers, worlds.planar(*worlds.START_VIEW))
    seen_by_all = jnp.ones_like(obs.visible)

    def error(xi):
        T_vehicle_world = (worlds.planar(0.0, 1.47, 0.3) @ jaxlie.SE3.exp(xi)).inverse()
        return e1(rig, markers, obs.corners_px, seen_by_all, T_vehicle_world)

    value, gradient = jax.jit(jax.value_and_grad(error))(jnp.zeros(6))
    assert gradient.dtype == precision
    assert np.isfinite(value)
    assert np.all(np.isfinite(gradient))


LENSES = {lens: coefficients for lens, coefficients, *_ in MODELS.values()}
SIDE, AXIS, BEHIND, PLANE = (0.3, -0.2, 1.5), (0.0, 0.0, 2.0), (0.4, 0.3, -1.0), (0.5, 0.2, 0.0)


def rig_of(lenses: list[str]) -> CameraRig:
    cameras = [Camera.create((320.0, 300.0), (400.0, 200.0), lens, LENSES[lens]) for lens in lenses]
    count = len(lenses)
    Ts = [pose_of(cayley(np.array([0.1, 0.2, -0.1, 0.1 * i, -0.3, 0.1]))) for i in range(count)]
    return CameraRig.create(cameras, Ts, [str(i) for i in range(count)], [(800, 400)] * count)


def sightings_of(rig: CameraRig, rng: np.random.Generator) -> Sightings:
    """Every camera sees a marker, but the last of several."""
    count = len(rig)
    return Sightings(
        camera_index=jnp.asarray(np.arange(count)),
        marker_index=jnp.asarray(np.zeros(count, int)),
        corners_px=jnp.asarray(rng.uniform(0, 400, (count, 4, 2))),
        rays=jnp.asarray(np.zeros((count, 4, 3))),  # not looked at
        sigma_px=jnp.asarray(rng.uniform(0.5, 2, (count, 4))),
        visible=jnp.asarray(np.arange(count) < max(count - 1, 1)),
    )


@jax.jit
def projected(rig: CameraRig, seen: Sightings, points: jax.Array) -> jax.Array:
    """Residuals (2, P, N) by `Camera.project`, point by point."""
    cameras, _ = cameras_of(rig, seen)

    def one(camera, T, corners_px, sigma_px, visible, corners):
        pixels = jax.vmap(camera.project)(jax.vmap(lambda p: T @ p)(corners))
        return jnp.where(visible, (pixels - corners_px) / sigma_px[:, None], 0)

    def of_pose(corners):
        return jax.vmap(one)(
            cameras, jaxlie.SE3(rig.Ts_camera_vehicle.wxyz_xyz[seen.camera_index]),
            seen.corners_px, seen.sigma_px, seen.visible, corners.T.reshape(-1, 4, 3),
        ).reshape(-1, 2).T  # fmt: skip

    return jax.vmap(of_pose, in_axes=-1, out_axes=-1)(points)


@jax.jit
def projected_slopes(rig: CameraRig, seen: Sightings, points: jax.Array) -> jax.Array:
    """By the three coordinates of all points."""
    directions = jnp.eye(3)[:, :, None, None] * jnp.ones_like(points)[None]
    return jax.vmap(lambda d: jax.jvp(lambda p: projected(rig, seen, p), (points,), (d,))[1])(
        directions
    )


rows_of = jax.jit(lambda rig, seen, points: reprojection_rows(rig, seen)(points))


@pytest.mark.parametrize(
    "lenses",
    [[*LENSES, "none"], ["equidistant"]]
    + [pytest.param([lens], marks=pytest.mark.long) for lens in LENSES if lens != "equidistant"],
)
def test_residuals_and_slopes_are_those_of_the_projection(lenses):
    """Also on the optical axis, in the camera's plane, and behind it."""
    rng = np.random.default_rng(len(lenses))
    rig = rig_of(lenses)
    seen = sightings_of(rig, rng)
    for special in (SIDE, AXIS, BEHIND, PLANE):
        in_camera = rng.normal(0, 0.2, (len(lenses), 4, 3)) + SIDE
        in_camera[:, 0] = special
        Ts = np.linalg.inv(matrix(rig.Ts_camera_vehicle.wxyz_xyz))
        points = np.einsum("cij,cpj->cpi", Ts[:, :3, :3], in_camera) + Ts[:, None, :3, 3]
        points = jnp.asarray(np.repeat(points.reshape(-1, 3).T[..., None], 2, axis=2))
        residual, slope = rows_of(rig, seen, points)
        np.testing.assert_allclose(residual, projected(rig, seen, points), atol=1e-8)
        expected = projected_slopes(rig, seen, points)
        np.testing.assert_allclose(slope, expected, rtol=1e-6, atol=1e-5)


def test_slopes_have_derivatives_and_are_finite_at_singular_points():
    """The covariance of a minimum is made of them, and is differentiated by a tuner."""
    rig = rig_of([*LENSES, "none"])  # of which the last is hidden
    count = len(rig)
    here = np.tile([1.0, 0, 0, 0, 0, 0, 0], (count, 1))
    rig = dataclasses.replace(rig, Ts_camera_vehicle=jaxlie.SE3(jnp.asarray(here)))
    rows = reprojection_rows(rig, sightings_of(rig, np.random.default_rng(0)))
    usual = np.array([[0.3, -0.2, 1.5], [0.1, 0.4, 1.0], [-0.5, 0.2, 2.0], [0.2, 0.1, 0.7]])

    def of_all(corners) -> jax.Array:
        return jnp.asarray(np.tile(corners, (count, 1)).T[..., None])

    check_derivatives(
        lambda p: jnp.sum(jnp.sin(rows(p.reshape(3, -1, 1))[1] / 300)), of_all(usual).reshape(-1)
    )

    @jax.jit
    def slopes(p):
        return [jax.grad(lambda p, part=part: jnp.sum(rows(p)[part]))(p) for part in (0, 1)]

    for corner in (AXIS, (0.0, 0.0, 0.0), (0.0, 0.0, -1.0), PLANE, (1e-9, 0.0, 1.0)):
        for slope in slopes(of_all([corner, *usual[1:]])):
            assert np.all(np.isfinite(slope)), corner


def test_a_pinhole_of_focal_length_one_looks_the_same():
    points = np.random.default_rng(0).normal(size=(3, 4, 2)) + 3
    corners_n = np.random.default_rng(1).normal(size=(4, 2))
    rows = jax.jit(lambda corners_n, points: pinhole_rows(corners_n, jnp.asarray(0.5))(points))
    residual, slope = rows(corners_n, points)
    expected = (points[:2] / points[2:] - corners_n.T[..., None]) / 0.5
    np.testing.assert_allclose(residual, expected, rtol=1e-12)
    np.testing.assert_allclose(slope[2], -2 * points[:2] / points[2:] ** 2, rtol=1e-12)


def test_arms_turn_as_by_the_quaternion():
    rng = np.random.default_rng(2)
    half, arms = rng.normal(size=(3, 5)), rng.normal(size=(3, 4, 5))
    actual = jax.jit(turn_arms)(half, arms)
    turns = Rotation.from_quat(np.column_stack([half.T, np.ones(5)])).as_matrix()
    np.testing.assert_allclose(actual, np.einsum("nij,jan->ian", turns, arms), atol=1e-12)
    cross = jax.jit(cross_product)(half, arms[:, 0])
    np.testing.assert_allclose(cross, np.cross(half.T, arms[:, 0].T).T)
