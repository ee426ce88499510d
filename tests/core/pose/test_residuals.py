"""e1 and e2 against loops written straight from the paper's equations."""

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
import pytest

from jaxnav.core.models.rig import CameraRig
from jaxnav.core.pose.residuals import e1, e2
from tests import worlds
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
