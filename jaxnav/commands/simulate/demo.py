"""`jaxnav demo`: the paper's experiment on rendered cameras.

Source: Liu, Schofield, Shan (2023), section III.
"""

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import jaxlie
import numpy as np
from jaxtyping import Float, UInt8
from tqdm import tqdm

from jaxnav.commands.bars import drawn_on
from jaxnav.commands.pictures import corners_in_world, normals_px, save_figure
from jaxnav.commands.process import configure_jax
from jaxnav.commands.simulate.arguments import Demo
from jaxnav.commands.simulate.rendered_world import RenderedCameras, RenderedWorld
from jaxnav.compiling.step import compiled_step
from jaxnav.configuration import step_folder
from jaxnav.errors import visible
from jaxnav.files import (
    output_folder,
    write_json,
    write_tum,
)
from jaxnav.models.geometry import T_world_vehicle_from_planar
from jaxnav.models.origin import planar_in_world, points_in_world, poses_in_world
from jaxnav.plots.localisation import AnnotatedFrame, Trajectory, camera_mosaic, drive_report
from jaxnav.recording.drive_setup import DriveSetup
from jaxnav.simulation.drive import (
    DriveFrame,
    DriveSettings,
    Methods,
    drive,
    waypoints_passed,
)

OURS = "our_method"
METHOD_A = "method_a_kf"
LABELS = {OURS: "our method", METHOD_A: "the paper's Method A + KF"}
START_SPREAD = np.array([0.05, 0.05, np.deg2rad(5.0)])  # around the route's start, m m rad
MOSAIC_ROWS = 3
KEEP_EVERY = 8  # one of this many frames keeps its images, for the mosaic


def run(args: Demo) -> int:
    """Drive with every seed, write reports, and print a line for each drive."""
    configure_jax(float64=True, threads=1)
    world = RenderedWorld.load(args)
    navigators = {
        OURS: world.navigator(args.selector),
        METHOD_A: world.navigator("lowest-reprojection-ungated"),
    }
    out = output_folder(args.out)
    if world.params is not None:
        print(world.params.describe())
    methods = Methods(navigators, lambda navigator: compiled_step(navigator, step_folder()))
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
    print(f"report in {visible(out)}")
    return 0


@dataclass(frozen=True)
class Record:
    """A finished drive: its N frames, and the images that were kept."""

    frames: list[DriveFrame]
    kept: dict[int, list[UInt8[np.ndarray, "rows columns"]]]  # frame number -> images

    @property
    def true_poses(self) -> Float[np.ndarray, "N 3"]:
        """True planar poses (N, 3): x m, y m, psi rad."""
        return np.array([frame.true_pose for frame in self.frames])

    def poses(self, method: str) -> Float[np.ndarray, "N 3"]:
        """A method's planar poses (N, 3): x m, y m, psi rad; NaN where it has none."""
        outputs = [frame.outputs[method] for frame in self.frames]
        return np.array([o.pose if o.located else np.full(3, np.nan) for o in outputs])


def _drive(args: Demo, world: RenderedWorld, methods: Methods, seed: int) -> Record:
    rng = np.random.default_rng(seed)
    start = np.asarray(world.setup.route_on_map.start_pose) + START_SPREAD * rng.uniform(-1, 1, 3)
    settings = DriveSettings(
        start_pose=(float(start[0]), float(start[1]), float(start[2])),
        duration_s=args.duration_s,
        floor_m=world.floor_m(),
    )
    cameras = RenderedCameras(world, rng, args.corner_noise_px)
    frames: list[DriveFrame] = []
    kept: dict[int, list[np.ndarray]] = {}
    with tqdm(
        total=round(args.duration_s, 1),
        unit="s",
        desc=f"drive, seed {seed}",
        disable=args.headless,
        bar_format="{desc}: {n:.1f} of at most {total:.0f} s [{elapsed}]{postfix}",
        **drawn_on(sys.stderr),
    ) as bar:
        bar.set_postfix_str("compiling")
        for frame in drive(methods, world.setup.vehicle, cameras.look, settings, seed):
            if len(frames) % KEEP_EVERY == 0:
                kept[len(frames)] = cameras.images
            frames.append(frame)
            pose = planar_in_world(frame.outputs[OURS].pose, world.setup.markers.origin_m)
            x_m, y_m, psi_rad = pose
            place = f"at ({x_m:.2f}, {y_m:.2f}) m, {np.rad2deg(psi_rad):.0f} deg"
            bar.set_postfix_str(place, refresh=False)
            bar.update(settings.frame_period_s)
    return Record(frames, kept)


def _summary(args: Demo, world: RenderedWorld, record: Record, seed: int) -> dict[str, Any]:
    passed = waypoints_passed(record.true_poses, np.asarray(world.setup.route_on_map.waypoints_m))
    finished = bool(record.frames[-1].outputs[OURS].done)
    return {
        "reached": finished and passed == len(world.setup.route_on_map.waypoints_m),
        "believes_done": finished,
        "waypoints_passed": passed,
        "duration_s": record.frames[-1].stamp_s,
        "steps": len(record.frames),
        "seed": seed,
        "selector": args.selector,
        "params": args.params,
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


def _write(folder: Path, world: RenderedWorld, record: Record, summary: dict[str, Any]) -> None:
    times_s = np.array([frame.stamp_s for frame in record.frames])
    setup, origin_m = world.setup, world.setup.markers.origin_m
    poses = {"truth": record.true_poses} | {name: record.poses(name) for name in (OURS, METHOD_A)}
    for name, rows in poses.items():
        known = np.isfinite(rows[:, 0])
        wxyz_xyz = T_world_vehicle_from_planar(jnp.asarray(rows[known])).wxyz_xyz
        Ts_world_vehicle = np.asarray(poses_in_world(wxyz_xyz, origin_m))
        write_tum(folder / f"{name}.tum", times_s[known], Ts_world_vehicle)
    poses = {name: planar_in_world(rows, origin_m) for name, rows in poses.items()}
    report = drive_report(
        times_s,
        Trajectory("truth", poses["truth"]),
        [Trajectory(LABELS[name], poses[name]) for name in (OURS, METHOD_A)],
        np.asarray(points_in_world(setup.route_on_map.waypoints_m, origin_m)),
        setup.route.waypoint_radius_m,
        corners_in_world(setup.markers),
        title=_one_line(summary),
    )
    save_figure(report, folder / "report.png")
    numbers = sorted(record.kept)
    chosen = [numbers[round(i)] for i in np.linspace(0, len(numbers) - 1, MOSAIC_ROWS)]
    mosaic = camera_mosaic(
        [_views(setup, record.kept[n], record.frames[n]) for n in dict.fromkeys(chosen)],
        title="detected marker: green; normal of the pose taken: blue, of the other pose: orange",
    )
    save_figure(mosaic, folder / "mosaic.png")
    write_json(folder / "summary.json", summary)


def _views(setup: DriveSetup, images: list[np.ndarray], frame: DriveFrame) -> list[AnnotatedFrame]:
    """Views of every camera's image, with the markers seen and the poses our method weighed."""
    rig, markers, output = setup.rig, setup.markers, frame.outputs[OURS]
    views = []
    corners_px = np.asarray(frame.observation.corners_px)
    visible = np.asarray(frame.observation.visible)
    valid = np.flatnonzero(output.candidates.valid)
    for c, image in enumerate(images):
        T_camera_vehicle = jaxlie.SE3(rig.Ts_camera_vehicle.wxyz_xyz[c])
        sticks: dict[bool, list[np.ndarray]] = {True: [], False: []}
        for m in np.flatnonzero(visible[c]):
            for n in valid:
                T_vehicle_world = jaxlie.SE3(
                    jnp.asarray(output.candidates.T_vehicle_world.wxyz_xyz[n])
                )
                T_world_marker = jaxlie.SE3(markers.Ts_world_marker.wxyz_xyz[m])
                T_camera_marker = T_camera_vehicle @ T_vehicle_world @ T_world_marker
                alone = jaxlie.SE3(T_camera_marker.wxyz_xyz[None])
                stick = normals_px(rig.camera(c), alone, markers.size_m[m][None])
                sticks[n == output.selected].append(stick[0])
        views.append(
            AnnotatedFrame(
                title=f"{rig.names[c]}, t = {frame.stamp_s:.2f} s",
                image=image,
                detected_px=corners_px[c][visible[c]],
                selected_px=np.asarray(sticks[True]).reshape(-1, 2, 2),
                other_px=np.asarray(sticks[False]).reshape(-1, 2, 2),
            )
        )
    return views


def _one_line(summary: dict[str, Any]) -> str:
    ours, method_a = (summary["methods"][name] for name in (OURS, METHOD_A))
    verdict = "reached all waypoints" if summary["reached"] else "did NOT reach all waypoints"
    return (
        f"seed {summary['seed']}: {verdict} in {summary['duration_s']:.1f} s; "
        f"position RMSE {ours['position_rmse_m']:.3f} m ({LABELS[METHOD_A]} "
        f"{method_a['position_rmse_m']:.3f} m), wrong branch {ours['wrong_branch_fraction']:.1%} "
        f"({method_a['wrong_branch_fraction']:.1%})"
    )
