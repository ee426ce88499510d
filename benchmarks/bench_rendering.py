"""Time a rendered frame: one QCar camera, 820 x 410 px, blur and rolling shutter, one thread.

Run with `OMP_NUM_THREADS=1 pytest benchmarks/bench_rendering.py --benchmark-only`.
"""

import jax.numpy as jnp
import jaxlie
import numpy as np
import pytest

from jaxnav.core.models.camera import Camera
from jaxnav.core.models.markers import MarkerMap
from jaxnav.core.models.rig import CameraRig
from jaxnav.sim.rendering import Renderer
from jaxnav.sim.scene import Scene
from jaxnav.sim.sensor import Sensor, Shutter

R_WORLD_WALL = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])
T_CAMERA_VEHICLE = np.array([[0.0, -1, 0, 0], [0, 0, -1, 0.0953], [1, 0, 0, -0.193], [0, 0, 0, 1]])


def paper_scene() -> Scene:
    T_world_marker = np.eye(4)
    T_world_marker[:3, :3], T_world_marker[:3, 3] = R_WORLD_WALL, [0, 1.47, 0.226]
    pose = jaxlie.SE3.from_matrix(jnp.asarray(T_world_marker[None]))
    return Scene.create(MarkerMap(pose, jnp.array([0.172]), (0,), ("tag36h11",)))


def front_camera() -> CameraRig:
    camera = Camera.create((319.0, 319.0), (401.0, 202.0), "equidistant")
    pose = jaxlie.SE3.from_matrix(jnp.asarray(T_CAMERA_VEHICLE))
    return CameraRig.create([camera], [pose], ["front"], [(820, 410)])


@pytest.mark.parametrize("noise", [True, False], ids=["with noise", "without noise"])
@pytest.mark.parametrize(
    "start", [(2.0, -1.0, 2.18), (0.2, 0.9, 1.75)], ids=["at 3.2 m", "at 0.5 m"]
)
def test_render(benchmark, start, noise):
    renderer = Renderer(paper_scene(), front_camera(), Shutter(6e-3, 30e-6), Sensor(noise=noise))
    x_m, y_m, psi_rad = start

    def T_world_vehicle_at(times_s):
        psi = psi_rad + 0.6 * times_s
        zero = np.zeros_like(psi)
        x, y = x_m + 0.3 * np.cos(psi_rad) * times_s, y_m + 0.3 * np.sin(psi_rad) * times_s
        return np.stack([np.cos(psi / 2), zero, zero, np.sin(psi / 2), x, y, zero], axis=-1)

    rng = np.random.default_rng(0)
    images = benchmark(renderer.render, T_world_vehicle_at, 0.0, rng)
    assert images[0].shape == (410, 820)
