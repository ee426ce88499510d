"""The world of a demo: objects built from its files, and cameras that render the scene."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, UInt8

from jaxnav.commands.reading import given_files
from jaxnav.commands.simulate.arguments import Demo
from jaxnav.core.models.camera import Camera
from jaxnav.core.models.geometry import T_world_vehicle_from_planar
from jaxnav.core.models.markers import MarkerMap
from jaxnav.core.models.rig import CameraRig
from jaxnav.core.models.vehicle import Vehicle
from jaxnav.core.navigator import Navigator, Output
from jaxnav.detection import Detections, Detector, Tracker, observe
from jaxnav.detection.observe import marker_keys
from jaxnav.errors import BadInput
from jaxnav.files import Params, calib_dir, load_car, load_params, load_route
from jaxnav.recordings.drive_setup import DriveSetup
from jaxnav.sim.drive import DriveSettings, PoseAt
from jaxnav.sim.rendering import Renderer
from jaxnav.sim.scene import Scene
from jaxnav.sim.sensor import Sensor, Shutter

READOUT_S = 12e-3  # from the first row to the last, usual for a small CSI sensor
# A small lens and a cheap sensor indoors: blurred by 0.7 px, 2 grey levels in the dark.
SENSOR = Sensor(psf_sigma_px=0.7, read_noise_grey=2.0, full_well_e=6000.0)
FLOOR_M = 5.0  # side of the floor around start, waypoints and markers, at least


@dataclass(frozen=True)
class RenderedWorld:
    """The objects of a demo, built from its files, with a renderer."""

    setup: DriveSetup  # without the parameters
    vehicle: Vehicle
    params: Params | None
    renderer: Renderer
    cameras: list[Camera]  # those of the rig, one by one

    @staticmethod
    def load(args: Demo) -> "RenderedWorld":
        """Read all files first, so that bad input is found before any work is done."""
        files = given_files(args, ("rig", "markers"), or_qcars=True)
        rig, markers, qcar = files["rig"], files["markers"], calib_dir() / "qcar"
        rows = max(height for _, height in rig.image_sizes_px)
        shutter = Shutter(
            exposure_s=args.exposure_ms / 1e3 if args.blur else 0.0,
            row_time_s=READOUT_S / rows if args.rolling_shutter else 0.0,
        )
        if shutter.exposure_s / 2 + READOUT_S / 2 > DriveSettings.latency_s:
            raise BadInput(
                "--exposure-ms",
                f"the last row would be read after the command is due "
                f"({DriveSettings.latency_s * 1e3:.0f} ms after the stamp), got {args.exposure_ms}",
            )
        vehicle = load_car(args.vehicle or qcar / "vehicle.yaml")
        route = load_route(args.route or qcar / "demo_route.yaml")
        return RenderedWorld(
            DriveSetup(rig, markers, vehicle, route, float64=True),
            vehicle,
            params=None if args.params is None else load_params(args.params),
            renderer=Renderer(Scene.create(markers, seed=args.seed), rig, shutter, SENSOR),
            cameras=[rig.camera(c) for c in range(len(rig))],
        )

    def navigator(self, selector: str) -> Navigator:
        """A navigator for this world, with one of `PILOT_SELECTORS`.

        Raises:
            BadInput: a parameter that does not fit it.
        """
        setup = replace(self.setup, selector=selector)
        return (setup if self.params is None else setup.with_params(self.params)).navigator()

    def floor_m(self) -> tuple[float, float, float, float]:
        """The floor that the car may use: x_min, x_max, y_min, y_max, m."""
        route = self.setup.route_on_map
        corners_m = np.asarray(self.setup.markers.corners_world_m)[..., :2].reshape(-1, 2)
        points = np.vstack([route.waypoints_m, [route.start_pose[:2]], corners_m])
        center, half = (points.min(axis=0) + points.max(axis=0)) / 2, np.ptp(points, axis=0) / 2
        half = np.maximum(half + 1.0, FLOOR_M / 2)
        low, high = center - half, center + half
        return float(low[0]), float(high[0]), float(low[1]), float(high[1])


_FOLLOW_WITHIN_PX = 15.0  # of its expected place
# Corners (C, M, 4, 2), visibility (C, M) and sigmas (C, M, 4) at one instant.
Seen = tuple[Float[np.ndarray, "C M 4 2"], Bool[np.ndarray, "C M"], Float[np.ndarray, "C M 4"]]


@dataclass
class RenderedCameras:
    """Cameras whose rendered images are searched around the driver's belief and everywhere else."""

    world: RenderedWorld
    detectors: Sequence[Detector]
    rng: np.random.Generator
    corner_noise_px: float = 0.0  # on top of the detection's errors
    # One a camera; none: markers that the detectors do not read are not followed.
    trackers: Sequence[Tracker] = ()
    # The latest, one a camera.
    images: list[UInt8[np.ndarray, "rows columns"]] = field(default_factory=list)
    _before: tuple[float, np.ndarray] | None = None  # the last stamp and prediction

    def look(self, T_world_vehicle_at: PoseAt, stamp_s: float, believed: Output | None) -> Seen:
        """What all cameras see at one instant."""
        self.images = self.world.renderer.render(T_world_vehicle_at, stamp_s, self.rng)
        return self.search(self.images, believed, stamp_s)

    def search(
        self,
        images: Sequence[UInt8[np.ndarray, "rows columns"]],
        believed: Output | None,
        stamp_s: float = 0.0,
    ) -> Seen:
        """What `look` returns, from images (one a camera) that are there already."""
        rig, markers = self.world.setup.rig, self.world.setup.markers
        predicted_px = np.zeros((len(rig), len(markers.ids), 4, 2))
        expected = np.zeros(predicted_px.shape[:2], bool)
        if believed is not None and believed.located:
            predicted_px, expected = jax.device_get(expected_corners(rig, markers, believed.pose))
        flow_px_s, ahead_s = None, 0.0
        if self._before is not None and self._before[0] < stamp_s:
            ahead_s = stamp_s - self._before[0]  # what is believed is of the frame before
            flow_px_s = np.mean(predicted_px - self._before[1], axis=-2) / ahead_s
        self._before = (stamp_s, predicted_px) if expected.any() else None
        detections, keys = [], marker_keys(markers)
        for c, (image, camera) in enumerate(zip(images, self.world.cameras, strict=True)):
            quads_px = predicted_px[c][expected[c]]
            found = [detector.detect(image, camera, quads_px) for detector in self.detectors]
            if self.trackers and len(quads_px):
                more = self.trackers[c].follow(
                    image,
                    camera,
                    [key for key, sees in zip(keys, expected[c], strict=True) if sees],
                    quads_px,
                    np.full(len(quads_px), _FOLLOW_WITHIN_PX),
                    None if flow_px_s is None else flow_px_s[c][expected[c]],
                    ahead_s,
                    Detections.concatenate(found),
                )
                found.append(more)
            detections.append(Detections.concatenate(found))
        observed = observe(detections, markers)
        noise_px = self.corner_noise_px * self.rng.standard_normal(observed.corners_px.shape)
        sigma_px = np.hypot(observed.sigma_px, self.corner_noise_px)
        return observed.corners_px + noise_px, observed.visible, sigma_px


@jax.jit
def expected_corners(
    rig: CameraRig, markers: MarkerMap, pose: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """Expected corners (C, M, 4, 2) from a pose, and whether each marker is in view, (C, M)."""
    T_vehicle_world = T_world_vehicle_from_planar(jnp.asarray(pose)).inverse()
    corners_world_m = markers.corners_world_m
    return (
        rig.project(T_vehicle_world, corners_world_m),
        jnp.all(rig.sees(T_vehicle_world, corners_world_m), axis=-1),
    )
