"""`jaxnav demo`: the paper's waypoints on rendered cameras, beside what people use otherwise.

Each method drives once, and the second also hears what the first sees. What people use otherwise is
`cv2.aruco.ArucoDetector`, which finds the markers and refines their corners, and the first of the
two poses of `cv2.solvePnPGeneric` with `SOLVEPNP_IPPE_SQUARE`, that of lower reprojection error. Of
our selectors that is "lowest-reprojection", whose poses come from the same IPPE; it stands on the
same filter as our method, with its gate and its restart.

Source: Liu, Schofield, Shan (2023), section III; Garrido-Jurado et al. (2014); Collins and Bartoli
(2014); OpenCV's documentation of both.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import cv2
import jax.numpy as jnp
import jaxlie
import numpy as np
from jaxtyping import Float, Shaped, UInt8

from jaxnav.commands.bars import progress_bar
from jaxnav.commands.process import configure_jax
from jaxnav.commands.report import corners_in_world, normals_px, write_report
from jaxnav.commands.simulate.arguments import Demo
from jaxnav.commands.simulate.rendered_world import RenderedCameras, RenderedWorld, expected_corners
from jaxnav.core.models.camera import Camera
from jaxnav.core.models.geometry import T_world_vehicle_from_planar, wrap_angle_np
from jaxnav.core.models.origin import Origin, planar_in_world, points_in_world, poses_in_world
from jaxnav.detection import Detections, Detector, Tracker, make_detectors
from jaxnav.detection.families import dictionary
from jaxnav.detection.types import grey
from jaxnav.drive.compiled_step import compiled_step
from jaxnav.errors import visible
from jaxnav.files import output_folder, write_json, write_tum
from jaxnav.files.configuration import step_folder
from jaxnav.recordings.drive_setup import DriveSetup
from jaxnav.sim.drive import DriveFrame, DriveSettings, Methods, drive, waypoints_passed
from jaxnav.sim.scores import WRONG_DEG

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from jaxnav.pictures.localisation import AnnotatedFrame

OURS, OPENCV = "our_method", "opencv_first_pose"
LABELS = {OURS: "our method", OPENCV: "OpenCV, first pose"}
HEARD = f"{LABELS[OPENCV]}, on the images of {LABELS[OURS]}"
OPENCV_SELECTOR = "lowest-reprojection"
# RMS along one axis in the demo's images, against the rendered truth: see docs/guide/demo.md.
OPENCV_SIGMA_PX = 0.5
START_SPREAD = np.array([0.05, 0.05, np.deg2rad(5.0)])  # around the route's start, m m rad
KEEP_EVERY = 8  # one of this many frames keeps its images, for the mosaic
MOSAIC_ROWS = 3
LOST_M = 1.0  # farther off than this, a car is lost: the paper's waypoints are 1.03 m apart
RATES = "how often it goes which way, over 20 seeds: docs/guide/demo.md"


def run(args: Demo) -> int:
    """Drive every seed with both methods, write reports, and print a line for each drive."""
    configure_jax(float64=True, threads=1)
    world = RenderedWorld.load(args)
    ours, opencv = make_methods(args, world)
    out = output_folder(args.out)
    if world.params is not None:
        print(world.params.describe())
    summaries = []
    for seed in range(args.seed, args.seed + args.seeds):
        drives = drive_both(args, world, ours, opencv, seed)
        folder = out if args.seeds == 1 else output_folder(out / f"seed_{seed}")
        summaries.append(summary_of(args, world, drives, seed))
        _write(folder, world.setup, drives, summaries[-1])
    if args.seeds > 1:
        together = overall(summaries)
        write_json(out / "summary.json", together)
        print("\n".join(overall_lines(together)))
    else:
        print(RATES)
    print(f"report in {visible(out)}")
    return 0


# --- the two methods -----------------------------------------------------------------------


class Method(NamedTuple):
    """A way from images to commands: what finds the corners, and a navigator, compiled once."""

    name: str
    detectors: Sequence[Detector]
    navigator: Methods


class OpenCVDetector:
    """Detects markers of one family as OpenCV does by itself, with its usual settings.

    Of its ways to refine corners it has the one that errs least in these images, subpixel.
    """

    ids = None  # all of them

    def __init__(self, family: str):
        """See `make_detector`."""
        self.family = family
        parameters = cv2.aruco.DetectorParameters()
        parameters.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_SUBPIX
        self._detector = cv2.aruco.ArucoDetector(dictionary(family), parameters)

    def detect(
        self,
        image: Shaped[np.ndarray, "..."],
        camera: Camera | None = None,
        predicted_corners_px: Float[np.ndarray, "K 4 2"] | None = None,
    ) -> Detections:
        """Detect all markers of the family, by neither lens nor predictions: `Detector.detect`."""
        del camera, predicted_corners_px
        quads, ids, _ = self._detector.detectMarkers(grey(image))
        count = len(quads)
        return Detections(
            ids=np.zeros(0, int) if ids is None else np.asarray(ids, int).ravel(),
            corners_px=np.array(quads, float).reshape(count, 4, 2),
            sigma_px=np.full((count, 4), OPENCV_SIGMA_PX),
            refined=np.ones(count, bool),
            families=(self.family,) * count,
        )


def make_methods(args: Demo, world: RenderedWorld) -> tuple[Method, Method]:
    """Ours and OpenCV's.

    Raises:
        BadInput: a parameter that does not fit, or a detector that is not installed.
    """

    def method(name: str, detectors: Sequence[Detector], selector: str) -> Method:
        alone = {name: world.navigator(selector)}
        methods = Methods(alone, lambda navigator: compiled_step(navigator, step_folder()))
        return Method(name, detectors, methods)

    markers = world.setup.markers
    opencv = [OpenCVDetector(family) for family in sorted(set(markers.families))]
    return (
        method(OURS, make_detectors(markers, args.corner_backend), args.selector),
        method(OPENCV, opencv, OPENCV_SELECTOR),
    )


# --- their drives --------------------------------------------------------------------------


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


class Drives(NamedTuple):
    """All of one seed: both methods drive from the same start."""

    driven: dict[str, Record]  # by the method that drove
    heard: Record  # OpenCV's, on the images of our drive


def drive_both(args: Demo, world: RenderedWorld, ours: Method, opencv: Method, seed: int) -> Drives:
    """Drive a seed with either method; the second one hears the first one's frames as well."""
    # Noise of its own: what is heard changes nothing of what our method is given.
    rng = np.random.default_rng([seed, 1])
    ears = RenderedCameras(world, opencv.detectors, rng, args.corner_noise_px)
    heard: list[DriveFrame] = []
    opencv.navigator.reset()

    def listen(frame: DriveFrame, images: list[np.ndarray]) -> None:
        corners_px, visible, sigma_px = (jnp.asarray(one) for one in ears.search(images, None))
        observation = replace(
            frame.observation, corners_px=corners_px, visible=visible, corner_sigma_px=sigma_px
        )
        outputs, branches = opencv.navigator.step(observation, jnp.asarray(frame.true_pose))
        heard.append(replace(frame, observation=observation, outputs=outputs, branches=branches))

    driven = {OURS: _drive(args, world, ours, seed, listen)}
    driven[OPENCV] = _drive(args, world, opencv, seed)
    return Drives(driven, Record(OPENCV, heard))


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


# --- how far poses and corners are off, and who arrives ------------------------------------


def summary_of(args: Demo, world: RenderedWorld, drives: Drives, seed: int) -> dict[str, Any]:
    """What summary.json says of one seed."""
    return {
        "seed": seed,
        "selector": args.selector,
        "params": args.params,
        "route": args.route,
        "corner_backend": args.corner_backend,
        "exposure_ms": args.exposure_ms if args.blur else 0.0,
        "rolling_shutter": args.rolling_shutter,
        "corner_noise_px": args.corner_noise_px,
        "drives": {
            name: _outcome(world, record) | _score(world, record)
            for name, record in drives.driven.items()
        },
        "alongside": _score(world, drives.heard),
    }


def _outcome(world: RenderedWorld, record: Record) -> dict[str, Any]:
    waypoints_m = np.asarray(world.setup.route_on_map.waypoints_m)
    passed = waypoints_passed(record.true_poses, waypoints_m)
    finished = bool(record.frames[-1].outputs[record.method].done)
    return {
        "reached": finished and passed == len(waypoints_m),
        "believes_done": finished,
        "waypoints_passed": passed,
        "duration_s": record.frames[-1].stamp_s,
        "steps": len(record.frames),
    }


def _score(world: RenderedWorld, record: Record) -> dict[str, float]:
    errors = record.poses - record.true_poses
    errors = errors[np.isfinite(errors[:, 0])] if np.isfinite(errors).any() else errors[:1]
    distance_m = np.hypot(errors[:, 0], errors[:, 1])
    yaw_deg = np.rad2deg(wrap_angle_np(errors[:, 2]))
    branches = [frame.branches[record.method] for frame in record.frames]
    judged = max(sum(bool(b.judged) for b in branches), 1)
    seen = np.array([frame.observation.visible for frame in record.frames])
    corners_px = np.array([frame.observation.corners_px for frame in record.frames])
    rig, markers = world.setup.rig, world.setup.markers
    # Where the true pose puts the corners at the stamp.
    true_px = np.array([expected_corners(rig, markers, pose)[0] for pose in record.true_poses])
    off_px = (corners_px - true_px)[seen]
    return {
        "position_rmse_m": np.sqrt(np.mean(distance_m**2)),
        "position_median_m": np.median(distance_m),
        "position_worst_m": np.max(distance_m),
        "yaw_rmse_deg": np.sqrt(np.mean(yaw_deg**2)),
        "wrong_heading_fraction": np.mean(np.abs(yaw_deg) > WRONG_DEG),
        "wrong_branch_fraction": sum(bool(b.wrong) for b in branches) / judged,
        "outlier_fraction": sum(bool(b.outlier) for b in branches) / judged,
        "marker_seen_fraction": np.mean(seen.any(axis=(1, 2))),
        "corner_rms_px": float(np.sqrt(np.mean(off_px**2))) if off_px.size else np.nan,
    }


def overall(summaries: list[dict[str, Any]]) -> dict[str, Any]:
    """What summary.json says of several seeds: counts, and medians over them."""

    def medians(scores: list[dict[str, Any]]) -> dict[str, float]:
        names = [name for name, score in scores[0].items() if isinstance(score, float)]
        return {name: float(np.median([score[name] for score in scores])) for name in names}

    methods = {}
    for name in (OURS, OPENCV):
        drives = [summary["drives"][name] for summary in summaries]
        methods[name] = {
            "reached": sum(drive["reached"] for drive in drives),
            "success_rate": np.mean([drive["reached"] for drive in drives]),
            "once_lost": sum(drive["position_worst_m"] > LOST_M for drive in drives),
        } | medians(drives)
    alongside = medians([summary["alongside"] for summary in summaries])
    return {"runs": len(summaries), "methods": methods, "alongside": alongside, "seeds": summaries}


def lines(summary: dict[str, Any]) -> list[str]:
    """One seed in words, a line for each drive and one for what listened."""
    of_drives = [
        f"{LABELS[name]}: {'reached' if one['reached'] else 'did NOT reach'} all waypoints in "
        f"{one['duration_s']:.1f} s; {_errors(one)}"
        for name, one in summary["drives"].items()
    ]
    said = [*of_drives, f"{HEARD}: {_errors(summary['alongside'])}"]
    return [f"seed {summary['seed']}, {line}" for line in said]


def _errors(score: dict[str, float]) -> str:
    return (
        f"position RMSE {score['position_rmse_m']:.3f} m, "
        f"wrong branch {score['wrong_branch_fraction']:.1%}, "
        f"heading over {WRONG_DEG:.0f} deg off in {score['wrong_heading_fraction']:.1%}"
    )


def overall_lines(overall: dict[str, Any]) -> list[str]:
    """All seeds in words, a line for each method."""
    return [
        f"{LABELS[name]}: reached all waypoints in {one['reached']} of {overall['runs']} drives; "
        f"median position RMSE {one['position_rmse_m']:.3f} m; "
        f"once more than {LOST_M:.0f} m off in {one['once_lost']}"
        for name, one in overall["methods"].items()
    ]


# --- report.png, mosaic.png, summary.json and trajectories ---------------------------------


def _write(folder: Path, setup: DriveSetup, drives: Drives, summary: dict[str, Any]) -> None:
    """Write all files of one seed into a folder, and print its lines."""
    from jaxnav.pictures.against_truth import Driven, report_against_truth

    origin_m = setup.markers.origin_m
    for name, record in drives.driven.items():
        _write_tum(folder / f"{name}.tum", record, record.poses, origin_m)
        _write_tum(folder / f"{name}_truth.tum", record, record.true_poses, origin_m)
    _write_tum(folder / f"{OPENCV}_alongside.tum", drives.heard, drives.heard.poses, origin_m)

    def driven(record: Record, label: str) -> Driven:
        poses = (planar_in_world(rows, origin_m) for rows in (record.true_poses, record.poses))
        return Driven(label, record.times_s, *poses)

    report = report_against_truth(
        [driven(record, LABELS[name]) for name, record in drives.driven.items()],
        np.asarray(points_in_world(setup.route_on_map.waypoints_m, origin_m)),
        setup.route.waypoint_radius_m,
        corners_in_world(setup.markers),
        WRONG_DEG,
        listened=[driven(drives.heard, HEARD)],
        title="\n".join([*lines(summary), RATES]),
    )
    mosaic = _mosaic(setup, drives.driven[OURS])
    write_report(folder, summary, lines(summary), report=report, mosaic=mosaic)


def _write_tum(path: Path, record: Record, poses: np.ndarray, origin_m: Origin) -> None:
    known = np.isfinite(poses[:, 0])
    wxyz_xyz = T_world_vehicle_from_planar(jnp.asarray(poses[known])).wxyz_xyz
    write_tum(path, record.times_s[known], np.asarray(poses_in_world(wxyz_xyz, origin_m)))


def _mosaic(setup: DriveSetup, record: Record) -> "Figure":
    from jaxnav.pictures.localisation import camera_mosaic

    numbers = sorted(record.kept)
    chosen = [numbers[round(i)] for i in np.linspace(0, len(numbers) - 1, MOSAIC_ROWS)]
    return camera_mosaic(
        [_views(setup, record.kept[n], record.frames[n]) for n in dict.fromkeys(chosen)],
        title="detected marker: green; normal of the pose taken: blue, of the other pose: orange",
    )


def _views(
    setup: DriveSetup, images: list[np.ndarray], frame: DriveFrame
) -> "list[AnnotatedFrame]":
    """Views of every camera's image, with the markers seen and the poses our method weighed."""
    from jaxnav.pictures.localisation import AnnotatedFrame

    rig, markers, output = setup.rig, setup.markers, frame.outputs[OURS]
    visible = np.asarray(frame.observation.visible)
    valid = np.flatnonzero(output.candidates.valid)
    Ts_vehicle_world = jaxlie.SE3(jnp.asarray(output.candidates.T_vehicle_world.wxyz_xyz)[valid])
    views = []
    for c, image in enumerate(images):
        T_camera_vehicle = jaxlie.SE3(rig.Ts_camera_vehicle.wxyz_xyz[c][None])
        seen = np.flatnonzero(visible[c])
        sticks = np.zeros((len(seen), len(valid), 2, 2))
        for stick, m in zip(sticks, seen, strict=True):
            T_world_marker = jaxlie.SE3(markers.Ts_world_marker.wxyz_xyz[m][None])
            Ts_camera_marker = T_camera_vehicle @ Ts_vehicle_world @ T_world_marker
            stick[:] = normals_px(rig.camera(c), Ts_camera_marker, markers.size_m[m][None])
        views.append(
            AnnotatedFrame(
                title=f"{rig.names[c]}, t = {frame.stamp_s:.2f} s",
                image=image,
                detected_px=np.asarray(frame.observation.corners_px)[c][visible[c]],
                selected_px=sticks[:, valid == output.selected].reshape(-1, 2, 2),
                other_px=sticks[:, valid != output.selected].reshape(-1, 2, 2),
            )
        )
    return views
