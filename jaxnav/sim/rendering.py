"""Render images of a scene through the exact lens of every camera of a moving rig.

A pixel is a square that collects light evenly over its area and over the exposure of its row.
Its value is the mean over samples (x, y, t) in that box. Every sample follows its own ray: the
lens model is inverted once for each pixel, and the pose is the true one at that instant, so
rolling shutter and motion blur need no model of their own. The background is rendered first, with
few samples; then the markers are rendered onto it, with many samples at their edges.
"""

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor

import numpy as np
from jaxtyping import Float, UInt8

from jaxnav.core.models.rig import CameraRig
from jaxnav.errors import BadInput
from jaxnav.sim.background import render_background
from jaxnav.sim.prints import Print, prints_of, render_print
from jaxnav.sim.scene import Scene
from jaxnav.sim.sensor import Sensor, Shutter
from jaxnav.sim.viewing import MovingCamera, PixelRays, PosePath

# times_s -> T_world_vehicle, wxyz_xyz
PoseAt = Callable[[Float[np.ndarray, " N"]], Float[np.ndarray, "N 7"]]

_POSES = 33  # instants at which the motion is sampled, over one image
_MAX_ROTATION_RAD = 0.01  # between two of them: linear interpolation is then 1.2e-5 rad off


class Renderer:
    """A renderer of a rig's images: some 20 ms of one core for an image of 820 x 410 px.

    Limits: occlusion of a marker is decided per pixel, not per sample; a surface that is narrower
    than 8 px in an image may be missing from it; markers have no back.
    """

    def __init__(
        self,
        scene: Scene,
        rig: CameraRig,
        shutter: Shutter | None = None,
        sensor: Sensor | None = None,
        threads: int | None = None,
        prints: Sequence[Print] = (),
    ):
        """Prepare the rays of every pixel.

        Args:
            scene: markers and surfaces.
            rig: the cameras.
            shutter: exposure and row time; a still, global shutter when left out.
            sensor: noise, gain and so on.
            threads: number of cameras rendered at a time; by default all of them.
            prints: further sheets, beside the scene's markers.
        """
        self.scene, self.rig = scene, rig
        self.shutter = Shutter() if shutter is None else shutter
        self.sensor = Sensor() if sensor is None else sensor
        self._threads = max(1, min(len(rig), threads or len(rig)))
        self._lenses = [
            PixelRays.create(rig.camera(i), *rig.image_sizes_px[i]) for i in range(len(rig))
        ]
        self._Ts_vehicle_camera = np.linalg.inv(
            np.asarray(rig.Ts_camera_vehicle.as_matrix(), float)
        )
        self._prints = [*prints_of(scene), *prints]

    def render(
        self, T_world_vehicle_at: PoseAt, stamp_s: float, rng: np.random.Generator
    ) -> list[UInt8[np.ndarray, "rows columns"]]:
        """One image of every camera.

        Args:
            T_world_vehicle_at: the true motion: times_s (N,) -> poses (N, 7) as w x y z, x y z,
                in s and m. Called with instants around `stamp_s` only.
            stamp_s: the middle of the exposure of the middle row.
            rng: source of the noise; given its state the images are deterministic.

        Returns:
            (H, W) uint8 for each camera, in the rig's order.
        """
        streams = rng.spawn(len(self.rig))
        lights = self.light(T_world_vehicle_at, stamp_s)
        return self._for_all(lambda index: self.sensor.read_out(lights[index], streams[index]))

    def render_still(
        self, T_world_vehicle: Float[np.ndarray, " 7"], rng: np.random.Generator
    ) -> list[UInt8[np.ndarray, "rows columns"]]:
        """One image of every camera from a vehicle at rest at the pose (7,), wxyz_xyz."""
        return self.render(_at_rest(T_world_vehicle), 0.0, rng)

    def light(
        self, T_world_vehicle_at: PoseAt, stamp_s: float
    ) -> list[Float[np.ndarray, "rows columns"]]:
        """The light on the sensors, before noise, gain and rounding: (H, W) float32 each."""
        poses = self._poses_around(T_world_vehicle_at, stamp_s)
        return self._for_all(lambda index: self._one_camera(index, poses))

    def light_still(
        self, T_world_vehicle: Float[np.ndarray, " 7"]
    ) -> list[Float[np.ndarray, "rows columns"]]:
        """`light` for a vehicle at rest at the pose (7,), wxyz_xyz."""
        return self.light(_at_rest(T_world_vehicle), 0.0)

    def _for_all(self, task: Callable[[int], np.ndarray]) -> list[np.ndarray]:
        indices = range(len(self.rig))
        if self._threads == 1:
            return [task(index) for index in indices]
        with ThreadPoolExecutor(self._threads) as pool:
            return list(pool.map(task, indices))

    def _poses_around(self, T_world_vehicle_at: PoseAt, stamp_s: float) -> PosePath:
        rows = max(lens.rows for lens in self._lenses)
        half_s = (rows - 1) / 2 * self.shutter.row_time_s + self.shutter.exposure_s / 2
        count = _POSES if half_s > 0 else 1
        while True:
            times_s = np.linspace(-half_s, half_s, count) if count > 1 else np.zeros(1)
            wxyz_xyz = np.asarray(T_world_vehicle_at(stamp_s + times_s), float)
            if wxyz_xyz.shape != (count, 7) or not np.all(np.isfinite(wxyz_xyz)):
                raise BadInput(
                    "T_world_vehicle_at",
                    f"must return finite poses of shape ({count}, 7) for {count} times, "
                    f"got shape {wxyz_xyz.shape}",
                )
            motion = PosePath.create(times_s, wxyz_xyz)
            steps = motion.rotation_steps_rad
            if not len(steps) or steps.max() <= _MAX_ROTATION_RAD or count > 4096:
                return motion
            count = 2 * count - 1

    def _one_camera(self, index: int, motion: PosePath) -> np.ndarray:
        lens = self._lenses[index]
        view = MovingCamera(lens, motion, self._Ts_vehicle_camera[index], self.shutter)
        image = render_background(self.scene, view)
        # Farthest first, in case papers overlap.
        _, position = view.pose_at(np.zeros(1))
        for marker in sorted(
            self._prints, key=lambda m: -float(np.linalg.norm(m.T_world_marker[:3, 3] - position))
        ):
            render_print(marker, self.scene.surfaces, view, image)
        image[~lens.valid] = 0
        return self.sensor.illuminate(np.maximum(image, 0), lens.center_px)


def _at_rest(T_world_vehicle: np.ndarray) -> PoseAt:
    pose = np.asarray(T_world_vehicle, float)
    return lambda times_s: np.broadcast_to(pose, (*np.shape(times_s), 7))
