"""`jaxnav demo`: the paper's experiment on rendered cameras.

Source: Liu, Schofield, Shan (2023), section III.
"""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from tqdm import tqdm

from jaxnav.ambiguity import LowestReprojection
from jaxnav.bicycle import Vehicle
from jaxnav.cli import Demo, configure_jax
from jaxnav.commands.pictures import save_figure, views_of
from jaxnav.commands.selectors import make_selector
from jaxnav.detection import Detector, make_detector, observe
from jaxnav.detection.types import Detections
from jaxnav.errors import BadInput
from jaxnav.files import (
    Route,
    calib_dir,
    load_markers,
    load_rig,
    load_route,
    load_vehicle,
    output_folder,
    write_json,
    write_tum,
)
from jaxnav.geometry import T_world_vehicle_from_planar
from jaxnav.markers import MarkerMap
from jaxnav.navigator import Navigator, Output
from jaxnav.plotting import Track, camera_mosaic, drive_report
from jaxnav.rig import CameraRig
from jaxnav.simulation.drive import (
    DriveSettings,
    Frame,
    Methods,
    PoseAt,
    drive,
    waypoints_passed,
)
from jaxnav.simulation.rendering import Renderer
from jaxnav.simulation.scene import Scene
from jaxnav.simulation.sensor import Sensor, Shutter

OURS = "our_method"
METHOD_A = "method_a_kf"
LABELS = {OURS: "our method", METHOD_A: "Method A + KF"}
ROW_TIME_S = 30e-6  # 410 rows in 12 ms, usual for a small CSI sensor
# A small lens and a cheap sensor indoors: blurred by 0.7 px, 2 grey levels in the dark.
SENSOR = Sensor(psf_sigma_px=0.7, read_noise_grey=2.0, full_well_e=6000.0)
START_SPREAD = np.array([0.05, 0.05, np.deg2rad(5.0)])  # around the route's start, m m rad
MOSAIC_ROWS = 3
KEEP_EVERY = 8  # of so many frames one keeps its images, for the mosaic
FLOOR_M = 5.0  # side of the floor around start, waypoints and markers, at least


def run(args: Demo) -> int:
    """Drive, report, and say in one line how it went."""
    configure_jax(float64=True)
    world = World.load(args)
    out = output_folder(args.out)
    methods = Methods(
        {
            OURS: world.navigator(make_selector(args.selector)),
            METHOD_A: world.navigator(LowestReprojection()),
        }
    )
    summaries = []
    for seed in range(args.seed, args.seed + args.seeds):
        record = _drive(args, world, methods, seed)
        folder = out if args.seeds == 1 else output_folder(out / f"seed_{seed}")
        summary = _summary(args, world, record, seed)
        _write(folder, world, record, summary)
        print(_one_line(summary))
        summaries.append(summary)
    if args.seeds > 1:
        overall = _overall(summaries)
        write_json(out / "summary.json", overall)
        print(f"reached in {overall['reached']} of {overall['runs']} drives")
    print(f"report in {out}")
    return 0


@dataclass(frozen=True)
class World:
    """The files of a demo as objects, and the cameras that look at the scene."""

    rig: CameraRig
    markers: MarkerMap
    vehicle: Vehicle
    route: Route
    renderer: Renderer
    detectors: list[Detector]

    @staticmethod
    def load(args: Demo) -> "World":
        """Read all files first, so that bad input is found before any work is done."""
        qcar = calib_dir() / "qcar"
        rig = load_rig(args.rig or qcar / "rig.yaml")
        markers = load_markers(args.markers or qcar / "markers.yaml")
        shutter = Shutter(
            exposure_s=args.exposure_ms / 1e3 if args.blur else 0.0,
            row_time_s=ROW_TIME_S if args.rolling_shutter else 0.0,
        )
        rows = max(height for _, height in rig.image_sizes_px)
        if shutter.exposure_s / 2 + rows / 2 * shutter.row_time_s > DriveSettings.latency_s:
            raise BadInput(
                "--exposure-ms",
                f"the last row would be read after the command is due "
                f"({DriveSettings.latency_s * 1e3:.0f} ms after the stamp), got {args.exposure_ms}",
            )
        return World(
            rig=rig,
            markers=markers,
            vehicle=load_vehicle(args.vehicle or qcar / "vehicle.yaml"),
            route=load_route(args.route or qcar / "route.yaml"),
            renderer=Renderer(Scene.create(markers, seed=args.seed), rig, shutter, SENSOR),
            detectors=[
                make_detector(args.corner_backend, family)
                for family in sorted(set(markers.families))
            ],
        )

    def navigator(self, selector: Any) -> Navigator:
        """A navigator for this world."""
        return Navigator(
            rig=self.rig,
            markers=self.markers,
            vehicle=self.vehicle,
            waypoints_m=self.route.waypoints_m,
            waypoint_radius_m=self.route.waypoint_radius_m,
            selector=selector,
        )

    def floor_m(self) -> tuple[float, float, float, float]:
        """The part of the world the car may use: x_min, x_max, y_min, y_max."""
        points = np.vstack(
            [
                self.route.waypoints_m,
                [self.route.start_pose[:2]],
                np.asarray(self.markers.corners_world_m)[..., :2].reshape(-1, 2),
            ]
        )
        center, half = (points.min(axis=0) + points.max(axis=0)) / 2, np.ptp(points, axis=0) / 2
        half = np.maximum(half + 1.0, FLOOR_M / 2)
        low, high = center - half, center + half
        return float(low[0]), float(high[0]), float(low[1]), float(high[1])


@dataclass
class Cameras:
    """Rendered images, searched for markers around the driver's belief and everywhere else."""

    world: World
    rng: np.random.Generator
    corner_noise_px: float = 0.0  # on top of what detection leaves
    images: list[np.ndarray] = field(default_factory=list)  # the latest, one a camera

    def look(
        self, T_world_vehicle_at: PoseAt, stamp_s: float, believed: Output | None
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Corners, visibility and sigma of one instant."""
        world = self.world
        self.images = world.renderer.render(T_world_vehicle_at, stamp_s, self.rng)
        predicted_px, expected = self._predicted(believed)
        found = [
            Detections.concatenate(
                [
                    detector.detect(image, world.rig.camera(c), predicted_px[c][expected[c]])
                    for detector in world.detectors
                ]
            )
            for c, image in enumerate(self.images)
        ]
        observed = observe(found, world.markers)
        noise_px = self.corner_noise_px * self.rng.standard_normal(observed.corners_px.shape)
        sigma_px = np.hypot(observed.sigma_px, self.corner_noise_px)
        return observed.corners_px + noise_px, observed.visible, sigma_px

    def _predicted(self, believed: Output | None) -> tuple[np.ndarray, np.ndarray]:
        lanes = (len(self.world.rig), len(self.world.markers.ids))
        if believed is None or not believed.located:
            return np.zeros((*lanes, 4, 2)), np.zeros(lanes, bool)
        return jax.device_get(_expect(self.world.rig, self.world.markers, believed.pose))


@jax.jit
def _expect(rig: CameraRig, markers: MarkerMap, pose: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Where each marker should appear from a pose, (C, M, 4, 2), and whether it should, (C, M)."""
    T_vehicle_world = T_world_vehicle_from_planar(jnp.asarray(pose)).inverse()
    corners_world_m = markers.corners_world_m
    return (
        rig.project(T_vehicle_world, corners_world_m),
        jnp.all(rig.sees(T_vehicle_world, corners_world_m), axis=-1),
    )


@dataclass(frozen=True)
class Record:
    """A finished drive."""

    frames: list[Frame]
    kept: dict[int, list[np.ndarray]]  # frame number -> images

    @property
    def true_poses(self) -> np.ndarray:
        """(N, 3)."""
        return np.array([frame.true_pose for frame in self.frames])

    def poses(self, method: str) -> np.ndarray:
        """(N, 3), NaN before the first pose."""
        outputs = [frame.outputs[method] for frame in self.frames]
        return np.array([o.pose if o.located else np.full(3, np.nan) for o in outputs])


def _drive(args: Demo, world: World, methods: Methods, seed: int) -> Record:
    rng = np.random.default_rng(seed)
    start = np.asarray(world.route.start_pose) + START_SPREAD * rng.uniform(-1, 1, 3)
    settings = DriveSettings(
        start_pose=(float(start[0]), float(start[1]), float(start[2])),
        duration_s=args.duration_s,
        floor_m=world.floor_m(),
    )
    cameras = Cameras(world, rng, args.corner_noise_px)
    frames: list[Frame] = []
    kept: dict[int, list[np.ndarray]] = {}
    with tqdm(
        total=round(args.duration_s, 1),
        unit="s",
        desc=f"drive, seed {seed}",
        disable=args.headless,
        bar_format="{desc}: {n:.1f} of at most {total:.0f} s [{elapsed}]{postfix}",
    ) as bar:
        bar.set_postfix_str("compiling")
        for frame in drive(methods, world.vehicle, cameras.look, settings, seed):
            if len(frames) % KEEP_EVERY == 0:
                kept[len(frames)] = cameras.images
            frames.append(frame)
            bar.update(settings.frame_period_s)
            x_m, y_m, psi_rad = frame.outputs[OURS].pose
            bar.set_postfix_str(f"at ({x_m:.2f}, {y_m:.2f}) m, {np.rad2deg(psi_rad):.0f} deg")
    return Record(frames, kept)


def _summary(args: Demo, world: World, record: Record, seed: int) -> dict[str, Any]:
    passed = waypoints_passed(record.true_poses, np.asarray(world.route.waypoints_m))
    finished = bool(record.frames[-1].outputs[OURS].done)
    return {
        "reached": finished and passed == len(world.route.waypoints_m),
        "believes_done": finished,
        "waypoints_passed": passed,
        "duration_s": record.frames[-1].stamp_s,
        "steps": len(record.frames),
        "seed": seed,
        "selector": args.selector,
        "corner_backend": args.corner_backend,
        "exposure_ms": args.exposure_ms if args.blur else 0.0,
        "rolling_shutter": args.rolling_shutter,
        "corner_noise_px": args.corner_noise_px,
        "marker_seen_fraction": np.mean([np.any(f.observation.visible) for f in record.frames]),
        "methods": {name: _score(record, name) for name in (OURS, METHOD_A)},
    }


def _score(record: Record, method: str) -> dict[str, float]:
    errors = record.poses(method) - record.true_poses
    errors = errors[np.isfinite(errors[:, 0])]
    yaw_deg = np.rad2deg((errors[:, 2] + np.pi) % (2 * np.pi) - np.pi)
    branches = [frame.branches[method] for frame in record.frames]
    judged = max(sum(bool(b.judged) for b in branches), 1)
    distance_m = np.linalg.norm(errors[:, :2], axis=1)
    return {
        "position_rmse_m": np.sqrt(np.mean(distance_m**2)) if len(errors) else np.nan,
        "position_median_m": np.median(distance_m) if len(errors) else np.nan,
        "yaw_rmse_deg": np.sqrt(np.mean(yaw_deg**2)) if len(errors) else np.nan,
        "wrong_branch_fraction": sum(bool(b.wrong) for b in branches) / judged,
        "outlier_fraction": sum(bool(b.outlier) for b in branches) / judged,
    }


def _overall(summaries: list[dict[str, Any]]) -> dict[str, Any]:
    return {
        "runs": len(summaries),
        "reached": sum(summary["reached"] for summary in summaries),
        "success_rate": np.mean([summary["reached"] for summary in summaries]),
        "methods": {
            name: {
                key: np.median([summary["methods"][name][key] for summary in summaries])
                for key in summaries[0]["methods"][name]
            }
            for name in (OURS, METHOD_A)
        },
        "drives": summaries,
    }


def _write(folder: Path, world: World, record: Record, summary: dict[str, Any]) -> None:
    times_s = np.array([frame.stamp_s for frame in record.frames])
    poses = {"truth": record.true_poses} | {name: record.poses(name) for name in (OURS, METHOD_A)}
    for name, rows in poses.items():
        known = np.isfinite(rows[:, 0])
        Ts_world_vehicle = T_world_vehicle_from_planar(jnp.asarray(rows[known]))
        write_tum(folder / f"{name}.tum", times_s[known], np.asarray(Ts_world_vehicle.wxyz_xyz))
    report = drive_report(
        times_s,
        Track("truth", poses["truth"]),
        [Track(LABELS[name], poses[name]) for name in (OURS, METHOD_A)],
        np.asarray(world.route.waypoints_m),
        world.route.waypoint_radius_m,
        np.asarray(world.markers.corners_world_m),
        title=_one_line(summary),
    )
    save_figure(report, folder / "report.png")
    numbers = sorted(record.kept)
    chosen = [numbers[round(i)] for i in np.linspace(0, len(numbers) - 1, MOSAIC_ROWS)]
    rows_of_views = [
        views_of(
            world.rig,
            world.markers.Ts_world_marker,
            world.markers.size_m,
            record.kept[number],
            np.asarray(record.frames[number].observation.corners_px),
            np.asarray(record.frames[number].observation.visible),
            record.frames[number].outputs[OURS],
            record.frames[number].stamp_s,
        )
        for number in dict.fromkeys(chosen)
    ]
    mosaic = camera_mosaic(
        rows_of_views,
        title="detected marker: green; normal of the pose taken: blue, of the other pose: orange",
    )
    save_figure(mosaic, folder / "mosaic.png")
    write_json(folder / "summary.json", summary)


def _one_line(summary: dict[str, Any]) -> str:
    ours, method_a = (summary["methods"][name] for name in (OURS, METHOD_A))
    verdict = "reached all waypoints" if summary["reached"] else "did NOT reach all waypoints"
    return (
        f"seed {summary['seed']}: {verdict} in {summary['duration_s']:.1f} s; "
        f"position RMSE {ours['position_rmse_m']:.3f} m (Method A + KF "
        f"{method_a['position_rmse_m']:.3f} m), wrong branch {ours['wrong_branch_fraction']:.1%} "
        f"({method_a['wrong_branch_fraction']:.1%})"
    )
