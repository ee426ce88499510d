"""Closed-form derivatives of the corners' residuals against differentiated projections."""

import dataclasses

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
import pytest

from jaxnav.core.models.camera import Camera
from jaxnav.core.models.rig import CameraRig
from jaxnav.core.pose.observation import Sightings, cameras_of
from jaxnav.core.pose.residuals import cross_product, pinhole_rows, reprojection_rows, turn_arms
from tests.derivatives import check_derivatives

LENSES = {
    "none": (),
    "radtan": (0.1, -0.05, 0.002, -0.003, 0.01),
    "rational": (0.1, -0.05, 0.002, -0.003, 0.01, 0.2, -0.03, 0.02),
    "thin_prism": (0.1, -0.05, 0.002, -0.003, 0.01, 0.2, -0.03, 0.02, 2e-3, -1e-3, 3e-3, 5e-4),
    "equidistant": (-0.02, 0.003, -0.004, 0.001),
    "omni": (1.2, 0.05, -0.02, 0.002, -0.003),
    "double_sphere": (-0.2, 0.6),
    "eucm": (0.6, 1.1),
}
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
