"""e1 and e2 against loops written straight from the paper's equations, and closed-form derivatives
against differentiated projections."""

import dataclasses

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
import pytest

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

VIEW = (0.2, 0.1, 0.6)
image_error = jax.jit(e1)
space_error = jax.jit(e2)


def reference_e1(rig, markers, corners_px, visible, T_vehicle_world):
    cameras = [rig.camera(index) for index in range(len(rig))]
    return paper.e1(
        [(np.asarray(c.K), c.lenses[int(c.lens_index)], np.asarray(c.distortion)) for c in cameras],
        np.asarray(rig.Ts_camera_vehicle.as_matrix()),
        np.asarray(markers.corners_world_m),
        np.asarray(corners_px),
        np.asarray(visible),
        np.asarray(T_vehicle_world.as_matrix()),
    )


@pytest.fixture(scope="module", params=["car", "hand-held"])
def world(request):
    """A rig, markers, a noisy view of them, and a pose near the true one."""
    rig = worlds.qcar_rig() if request.param == "car" else worlds.handheld_rig()
    markers = worlds.room_markers()
    T_world_vehicle = worlds.planar(*VIEW)
    if request.param == "hand-held":
        # Its y axis points down.
        upright = jaxlie.SO3.from_x_radians(jnp.asarray(-np.pi / 2))
        T_world_vehicle = T_world_vehicle @ jaxlie.SE3.from_rotation(upright)
    rng = np.random.default_rng(0)
    noise = jnp.asarray(rng.normal(size=(4, 4, 4, 2)))
    obs = worlds.observe(rig, markers, T_world_vehicle, noise)
    assert np.sum(obs.visible) >= 5
    off = jaxlie.SE3.exp(jnp.asarray(rng.normal(0, 0.03, 6)))
    return rig, markers, obs, (T_world_vehicle @ off).inverse()


def test_e1_is_equation_3(world):
    rig, markers, obs, T_vehicle_world = world
    value = image_error(rig, markers, obs.corners_px, obs.visible, T_vehicle_world)
    expected = reference_e1(rig, markers, obs.corners_px, obs.visible, T_vehicle_world)
    assert expected > 100
    np.testing.assert_allclose(value, expected, rtol=1e-11)


def test_hidden_lanes_add_nothing(world):
    rig, markers, obs, T_vehicle_world = world
    clean = image_error(rig, markers, obs.corners_px, obs.visible, T_vehicle_world)
    filled = jnp.where(obs.visible[:, :, None, None], obs.corners_px, jnp.nan)
    assert image_error(rig, markers, filled, obs.visible, T_vehicle_world) == clean
    nothing = jnp.zeros_like(obs.visible)
    assert image_error(rig, markers, filled, nothing, T_vehicle_world) == 0


def test_e2_is_equation_14(world):
    _, markers, obs, T_vehicle_world = world
    prior = T_vehicle_world @ jaxlie.SE3.exp(jnp.asarray([0.1, -0.2, 0.05, 0.1, 0.2, -0.3]))
    in_view = np.any(np.asarray(obs.visible), axis=0)
    in_view[0] = False
    visible = obs.visible & jnp.asarray(in_view)[None]
    value = space_error(markers, visible, T_vehicle_world, prior)
    matrices = (np.asarray(T.as_matrix()) for T in (T_vehicle_world, prior))
    expected = paper.e2(np.asarray(markers.corners_world_m), in_view, *matrices)
    assert expected > 0.01
    np.testing.assert_allclose(value, expected, rtol=1e-11)


def test_a_marker_seen_by_two_cameras_counts_once_in_e2_and_twice_in_e1():
    rig, markers = worlds.qcar_rig(), worlds.paper_markers()
    T_world_vehicle = worlds.planar(*worlds.OVERLAP_VIEW)
    obs = worlds.observe(rig, markers, T_world_vehicle)
    both = obs.visible
    assert int(np.sum(both)) == 2
    one = both.at[3].set(False)
    other = both.at[0].set(False)
    T = (T_world_vehicle @ jaxlie.SE3.exp(jnp.full(6, 0.01))).inverse()
    prior = T_world_vehicle.inverse()
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
    Ts = [jaxlie.SE3.exp(jnp.asarray([0.1, 0.2, -0.1, 0.2 * i, -0.3, 0.1])) for i in range(3)]
    return CameraRig.create(
        cameras, Ts[: len(lenses)], [str(i) for i in range(len(lenses))], [(800, 400)] * len(lenses)
    )


def sightings_of(rig: CameraRig, rng: np.random.Generator) -> Sightings:
    """Every camera sees a marker, but the last of several."""
    count = len(rig)
    corners_px = jnp.asarray(rng.uniform(0, 400, (count, 4, 2)))
    return Sightings(
        camera_index=jnp.arange(count),
        marker_index=jnp.zeros(count, int),
        corners_px=corners_px,
        rays=jax.vmap(lambda camera, px: camera.unproject(px))(rig.cameras, corners_px),
        sigma_px=jnp.asarray(rng.uniform(0.5, 2, (count, 4))),
        visible=jnp.arange(count) < max(count - 1, 1),
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


@jax.jit
def in_vehicle(rig: CameraRig, in_camera: jax.Array) -> jax.Array:
    return jax.vmap(lambda T, ps: jax.vmap(lambda p: T.inverse() @ p)(ps))(
        rig.Ts_camera_vehicle, in_camera
    )


rows_of = jax.jit(lambda rig, seen, points: reprojection_rows(rig, seen)(points))


@pytest.mark.parametrize(
    "lenses",
    [[lens] for lens in LENSES] + [["radtan", "equidistant", "none"]],
)
def test_residuals_and_slopes_are_those_of_the_projection(lenses):
    """Also on the optical axis, in the camera's plane, and behind it."""
    rng = np.random.default_rng(len(lenses))
    rig = rig_of(lenses)
    seen = sightings_of(rig, rng)
    for special in (SIDE, AXIS, BEHIND, PLANE):
        in_camera = rng.normal(0, 0.2, (len(lenses), 4, 3)) + SIDE
        in_camera[:, 0] = special
        points = in_vehicle(rig, jnp.asarray(in_camera))
        points = points.reshape(-1, 3).T[..., None] * jnp.ones((1, 1, 2))  # two poses alike
        residual, slope = rows_of(rig, seen, points)
        np.testing.assert_allclose(residual, projected(rig, seen, points), atol=1e-8)
        expected = projected_slopes(rig, seen, points)
        np.testing.assert_allclose(slope, expected, rtol=1e-6, atol=1e-5)


@pytest.mark.parametrize("lens", LENSES)
def test_slopes_have_derivatives_and_are_finite_at_singular_points(lens):
    """The covariance of a minimum is made of them, and is differentiated by a tuner."""
    rig = rig_of([lens])
    rig = dataclasses.replace(rig, Ts_camera_vehicle=jaxlie.SE3.identity((1,)))
    rows = reprojection_rows(rig, sightings_of(rig, np.random.default_rng(0)))
    usual = jnp.asarray([[0.3, -0.2, 1.5], [0.1, 0.4, 1.0], [-0.5, 0.2, 2.0], [0.2, 0.1, 0.7]])
    check_derivatives(
        lambda p: jnp.sum(jnp.sin(rows(p.reshape(3, 4, 1))[1] / 300)), usual.T.reshape(-1)
    )
    slopes = [jax.jit(jax.grad(lambda p, part=part: jnp.sum(rows(p)[part]))) for part in (0, 1)]
    for corner in (AXIS, (0.0, 0.0, 0.0), (0.0, 0.0, -1.0), PLANE, (1e-9, 0.0, 1.0)):
        points = usual.at[0].set(jnp.asarray(corner)).T[..., None]
        for slope in slopes:
            assert np.all(np.isfinite(slope(points)))


def test_a_pinhole_of_focal_length_one_looks_the_same():
    points = jnp.asarray(np.random.default_rng(0).normal(size=(3, 4, 2))) + 3
    corners_n = jnp.asarray(np.random.default_rng(1).normal(size=(4, 2)))
    residual, slope = pinhole_rows(corners_n, jnp.asarray(0.5))(points)
    expected = (points[:2] / points[2:] - corners_n.T[..., None]) / 0.5
    np.testing.assert_allclose(residual, expected, rtol=1e-12)
    np.testing.assert_allclose(slope[2], -2 * points[:2] / points[2:] ** 2, rtol=1e-12)


def test_arms_turn_as_by_the_quaternion():
    rng = np.random.default_rng(2)
    half, arms = rng.normal(size=(3, 5)), rng.normal(size=(3, 4, 5))
    actual = turn_arms(jnp.asarray(half), jnp.asarray(arms))
    for lane in range(5):
        rotation = jaxlie.SO3(jnp.asarray([1.0, *half[:, lane]])).normalize()
        np.testing.assert_allclose(
            actual[..., lane], rotation.as_matrix() @ arms[..., lane], atol=1e-12
        )
    np.testing.assert_allclose(
        cross_product(jnp.asarray(half), jnp.asarray(arms[:, 0])), np.cross(half.T, arms[:, 0].T).T
    )
