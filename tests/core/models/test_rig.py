"""The camera cluster against the paper's matrices, camera by camera."""

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np

from jaxnav.core.models.camera import Camera
from jaxnav.core.models.rig import CameraRig
from tests import worlds
from tests.derivatives import check_derivatives
from tests.reference import paper


def reference_cameras(rig: CameraRig) -> list[tuple[np.ndarray, str, np.ndarray]]:
    """(K, lens, coefficients) of each camera, for the reference."""
    cameras = [rig.camera(index) for index in range(len(rig))]
    return [
        (np.asarray(c.K), c.lenses[int(c.lens_index)], np.asarray(c.distortion)) for c in cameras
    ]


def mixed_rig() -> CameraRig:
    """A pinhole, a distorted lens and a fisheye, no two of them at one place."""
    Ts = jaxlie.SE3.exp(jnp.asarray(np.random.default_rng(0).normal(0, 0.2, (3, 6))))
    cameras = [
        Camera.create((500.0, 510.0), (320.0, 240.0)),
        Camera.create((400.0, 405.0), (330.0, 235.0), "radtan", [-0.2, 0.05, 1e-3, -2e-3, 0.01]),
        Camera.create((300.0, 300.0), (310.0, 250.0), "equidistant", [0.01, -0.02, 0.003, 0.0]),
    ]
    return CameraRig.create(
        cameras, [jaxlie.SE3(T) for T in Ts.wxyz_xyz], ["a", "b", "c"], [(640, 480)] * 3
    )


def test_projection_is_equation_2():
    rng = np.random.default_rng(1)
    rig = mixed_rig()
    T_vehicle_world = jaxlie.SE3.exp(jnp.asarray(rng.normal(0, 0.1, 6)))
    points_world = np.column_stack([rng.uniform(-1, 1, (20, 2)), rng.uniform(3, 6, 20)])
    points = jnp.asarray(points_world.reshape(5, 4, 3))
    pixels = jax.jit(lambda T, points: rig.project(T, points))(T_vehicle_world, points)
    assert pixels.shape == (3, 5, 4, 2)
    for j, camera in enumerate(reference_cameras(rig)):
        T_camera_world = np.asarray(
            (jaxlie.SE3(rig.Ts_camera_vehicle.wxyz_xyz[j]) @ T_vehicle_world).as_matrix()
        )
        for i, point in enumerate(points_world):
            expected = paper.project(*camera, T_camera_world[:3] @ np.append(point, 1))
            np.testing.assert_allclose(pixels[j, i // 4, i % 4], expected, atol=1e-9)


def test_the_qcar_s_cameras_look_front_right_rear_left(precision):
    rig = worlds.qcar_rig()
    assert rig.names == ("front", "right", "rear", "left")
    assert len(rig) == 4
    Ts_vehicle_camera = rig.Ts_camera_vehicle.inverse()
    optical_axes = Ts_vehicle_camera.rotation().as_matrix()[:, :, 2]
    expected = [[1, 0, 0], [0, -1, 0], [-1, 0, 0], [0, 1, 0]]
    np.testing.assert_allclose(optical_axes, expected, atol=1e-6)
    down = Ts_vehicle_camera.rotation().as_matrix()[:, :, 1]
    np.testing.assert_allclose(down, [[0, 0, -1]] * 4, atol=1e-6)
    assert rig.cameras.focal_px.dtype == precision


def test_sees_means_in_front_and_inside():
    camera = Camera.create((100.0, 100.0), (50.0, 40.0))
    rig = CameraRig.create([camera], [jaxlie.SE3.identity()], ["only"], [(101, 81)])
    pixels = np.array([[50, 40], [-0.4, 40], [-0.6, 40], [100.4, 40], [100.6, 40], [50, 80.6]])
    points = np.column_stack([(pixels - [50, 40]) / 100, np.ones(6)])
    sees = rig.sees(jaxlie.SE3.identity(), jnp.asarray(np.concatenate([points, -points])))
    assert sees.tolist() == [[True, True, False, True, False, False] + [False] * 6]


def test_views_of_the_paper_s_marker():
    rig, markers = worlds.qcar_rig(), worlds.paper_markers()
    for pose, cameras in {
        worlds.START_VIEW: [0],
        worlds.OVERLAP_VIEW: [0, 3],
        worlds.NO_VIEW: [],
    }.items():
        visible = worlds.observe(rig, markers, worlds.planar(*pose)).visible
        assert np.flatnonzero(visible[:, 0]).tolist() == cameras


def test_derivatives_with_respect_to_pose_and_extrinsics():
    rig = mixed_rig()
    points = jnp.asarray([[0.3, -0.2, 4.0], [0.0, 0.0, 5.0]])

    def pixels(xi, extrinsic_xi):
        Ts = jax.vmap(lambda T, x: T @ jaxlie.SE3.exp(x))(rig.Ts_camera_vehicle, extrinsic_xi)
        moved = CameraRig(rig.cameras, Ts, rig.names, rig.image_sizes_px)
        return moved.project(jaxlie.SE3.exp(xi), points)

    # At zero, where the exponential map is removable-singular.
    check_derivatives(pixels, jnp.zeros(6), jnp.zeros((3, 6)), atol=1e-4)
