"""The files of a demo's seed: report.png, mosaic.png, summary.json and trajectories."""

from pathlib import Path
from typing import Any

import jax.numpy as jnp
import jaxlie
import numpy as np
from matplotlib.figure import Figure

from jaxnav.commands.report import corners_in_world, normals_px, save_figure
from jaxnav.commands.simulate.demo_drives import LABELS, OURS, Drives, Record
from jaxnav.commands.simulate.demo_scores import RATES, lines
from jaxnav.core.models.geometry import T_world_vehicle_from_planar
from jaxnav.core.models.origin import Origin, planar_in_world, points_in_world, poses_in_world
from jaxnav.files import write_json, write_tum
from jaxnav.pictures.against_truth import Driven, report_against_truth
from jaxnav.pictures.localisation import AnnotatedFrame, camera_mosaic
from jaxnav.recordings.drive_setup import DriveSetup
from jaxnav.sim.drive import DriveFrame
from jaxnav.sim.scores import WRONG_DEG

MOSAIC_ROWS = 3


def write_report(folder: Path, setup: DriveSetup, drives: Drives, summary: dict[str, Any]) -> None:
    """Write all files of one seed into a folder."""
    origin_m = setup.markers.origin_m
    for name, record in drives.driven.items():
        _write_tum(folder / f"{name}.tum", record, record.poses, origin_m)
        _write_tum(folder / f"{name}_truth.tum", record, record.true_poses, origin_m)
    heard = drives.alongside
    _write_tum(folder / f"{heard.method}_alongside.tum", heard, heard.poses, origin_m)

    def driven(record: Record, label: str) -> Driven:
        poses = (planar_in_world(rows, origin_m) for rows in (record.true_poses, record.poses))
        return Driven(label, record.times_s, *poses)

    report = report_against_truth(
        [driven(record, LABELS[name]) for name, record in drives.driven.items()],
        np.asarray(points_in_world(setup.route_on_map.waypoints_m, origin_m)),
        setup.route.waypoint_radius_m,
        corners_in_world(setup.markers),
        WRONG_DEG,
        listened=[driven(heard, f"{LABELS[heard.method]}, on the images of {LABELS[OURS]}")],
        title="\n".join([*lines(summary), RATES]),
    )
    save_figure(report, folder / "report.png")
    save_figure(_mosaic(setup, drives.ours), folder / "mosaic.png")
    write_json(folder / "summary.json", summary)


def _write_tum(path: Path, record: Record, poses: np.ndarray, origin_m: Origin) -> None:
    known = np.isfinite(poses[:, 0])
    wxyz_xyz = T_world_vehicle_from_planar(jnp.asarray(poses[known])).wxyz_xyz
    write_tum(path, record.times_s[known], np.asarray(poses_in_world(wxyz_xyz, origin_m)))


def _mosaic(setup: DriveSetup, record: Record) -> Figure:
    numbers = sorted(record.kept)
    chosen = [numbers[round(i)] for i in np.linspace(0, len(numbers) - 1, MOSAIC_ROWS)]
    return camera_mosaic(
        [_views(setup, record.kept[n], record.frames[n]) for n in dict.fromkeys(chosen)],
        title="detected marker: green; normal of the pose taken: blue, of the other pose: orange",
    )


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
