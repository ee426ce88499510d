"""The drives of a demo: each method drives once, and the second also hears what the first sees."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, UInt8

from jaxnav.commands.bars import progress_bar
from jaxnav.commands.simulate.arguments import Demo
from jaxnav.commands.simulate.rendered_world import RenderedCameras, RenderedWorld
from jaxnav.commands.simulate.runner_up import SELECTOR, opencv_detectors
from jaxnav.core.models.geometry import wrap_angle_np
from jaxnav.core.models.origin import planar_in_world
from jaxnav.detection import Detector, Tracker, make_detectors
from jaxnav.drive.compiled_step import compiled_step
from jaxnav.files.configuration import step_folder
from jaxnav.sim.drive import DriveFrame, DriveSettings, Methods, drive

OURS, OPENCV = "our_method", "opencv_first_pose"
LABELS = {OURS: "our method", OPENCV: "OpenCV, first pose"}
START_SPREAD = np.array([0.05, 0.05, np.deg2rad(5.0)])  # around the route's start, m m rad
KEEP_EVERY = 8  # one of this many frames keeps its images, for the mosaic


@dataclass(frozen=True)
class Method:
    """A way from images to commands: what finds the corners, and a navigator, compiled once."""

    name: str
    detectors: Sequence[Detector]
    navigator: Methods  # alone


@dataclass(frozen=True)
class Record:
    """What one method made of a drive of N frames, and the images that were kept."""

    method: str
    frames: list[DriveFrame]
    kept: dict[int, list[UInt8[np.ndarray, "rows columns"]]] = field(default_factory=dict)

    @property
    def times_s(self) -> Float[np.ndarray, " N"]:
        """Stamps (N,)."""
        return np.array([frame.stamp_s for frame in self.frames])

    @property
    def true_poses(self) -> Float[np.ndarray, "N 3"]:
        """True planar poses (N, 3): x m, y m, psi rad."""
        return np.array([frame.true_pose for frame in self.frames])

    @property
    def poses(self) -> Float[np.ndarray, "N 3"]:
        """The method's planar poses (N, 3): x m, y m, psi rad; NaN where it has none."""
        outputs = [frame.outputs[self.method] for frame in self.frames]
        return np.array([o.pose if o.located else np.full(3, np.nan) for o in outputs])

    @property
    def errors(self) -> Float[np.ndarray, "N 3"]:
        """Errors of `poses` (N, 3): m m rad, the heading's in [-pi, pi)."""
        errors = self.poses - self.true_poses
        errors[:, 2] = wrap_angle_np(errors[:, 2])
        return errors


@dataclass(frozen=True)
class Drives:
    """All of one seed: both methods drive from the same start."""

    ours: Record
    opencv: Record
    alongside: Record  # the second method, on the images of our drive

    @property
    def driven(self) -> Mapping[str, Record]:
        """The drives, by the method that drove."""
        return {record.method: record for record in (self.ours, self.opencv)}


def make_methods(args: Demo, world: RenderedWorld) -> tuple[Method, Method]:
    """Ours and OpenCV's.

    Raises:
        BadInput: a parameter that does not fit, or a detector that is not installed.
    """

    def method(name: str, detectors: Sequence[Detector], selector: str) -> Method:
        navigators = {name: world.navigator(selector)}
        return Method(
            name, detectors, Methods(navigators, lambda one: compiled_step(one, step_folder()))
        )

    markers = world.setup.markers
    return (
        method(OURS, make_detectors(markers, args.corner_backend), args.selector),
        method(OPENCV, opencv_detectors(markers), SELECTOR),
    )


def drive_both(args: Demo, world: RenderedWorld, ours: Method, opencv: Method, seed: int) -> Drives:
    """Drive a seed with either method; the second one hears the first one's frames as well."""
    # Noise of its own: what is heard changes nothing of what our method is given.
    rng = np.random.default_rng([seed, 1])
    ears = RenderedCameras(world, opencv.detectors, rng, args.corner_noise_px)
    heard: list[DriveFrame] = []
    opencv.navigator.reset()

    def listen(frame: DriveFrame, images: list[np.ndarray]) -> None:
        corners_px, visible, sigma_px = ears.search(images, None)
        observation = replace(
            frame.observation,
            corners_px=jnp.asarray(corners_px, float),
            visible=jnp.asarray(visible),
            corner_sigma_px=jnp.asarray(sigma_px, float),
        )
        outputs, branches = opencv.navigator.step(observation, jnp.asarray(frame.true_pose))
        heard.append(replace(frame, observation=observation, outputs=outputs, branches=branches))

    driven = _drive(args, world, ours, seed, listen)
    return Drives(driven, _drive(args, world, opencv, seed), Record(OPENCV, heard))


def _drive(
    args: Demo,
    world: RenderedWorld,
    method: Method,
    seed: int,
    listen: Callable[[DriveFrame, list[np.ndarray]], None] | None = None,
) -> Record:
    rng = np.random.default_rng(seed)
    start = np.asarray(world.setup.route_on_map.start_pose) + START_SPREAD * rng.uniform(-1, 1, 3)
    settings = DriveSettings(
        start_pose=(float(start[0]), float(start[1]), float(start[2])),
        duration_s=args.duration_s,
        floor_m=world.floor_m(),
    )
    follows = args.detector == "follow" and method.name == OURS
    shutter = world.renderer.shutter
    trackers = [Tracker(shutter.exposure_s, shutter.row_time_s) for _ in world.cameras if follows]
    cameras = RenderedCameras(world, method.detectors, rng, args.corner_noise_px, trackers=trackers)
    record = Record(method.name, [])
    with progress_bar(
        total=round(args.duration_s, 1),
        unit="s",
        desc=f"seed {seed}, {LABELS[method.name]}",
        disable=args.headless,
        bar_format="{desc}: {n:.1f} of at most {total:.0f} s [{elapsed}]{postfix}",
    ) as bar:
        bar.set_postfix_str("compiling")
        for frame in drive(method.navigator, world.vehicle, cameras.look, settings, seed):
            if len(record.frames) % KEEP_EVERY == 0:
                record.kept[len(record.frames)] = cameras.images
            record.frames.append(frame)
            if listen is not None:
                listen(frame, cameras.images)
            pose = planar_in_world(frame.outputs[method.name].pose, world.setup.markers.origin_m)
            x_m, y_m, psi_rad = pose
            place = f"at ({x_m:.2f}, {y_m:.2f}) m, {np.rad2deg(psi_rad):.0f} deg"
            bar.set_postfix_str(place, refresh=False)
            bar.update(settings.frame_period_s)
    return record
