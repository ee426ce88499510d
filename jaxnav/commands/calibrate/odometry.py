"""`jaxnav calibrate odometry`: speed scale, steering, wheelbase and the cameras' delay."""

from collections.abc import Iterable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np

from jaxnav.calibrate.odometry.calibrate import OdometryCalibration, calibrate_odometry
from jaxnav.calibrate.odometry.drive import Drive
from jaxnav.calibrate.odometry.model import NAMES
from jaxnav.commands.bars import progress_bar
from jaxnav.commands.calibrate.arguments import CalibrateOdometry as Arguments
from jaxnav.commands.process import configure_jax
from jaxnav.commands.reading import given_files, read_shown
from jaxnav.commands.report import corners_in_world, provenance, publish
from jaxnav.core.models.markers import MarkerMap
from jaxnav.core.models.origin import planar_in_world
from jaxnav.core.models.rig import CameraRig
from jaxnav.core.models.vehicle import Vehicle
from jaxnav.detection import Detections
from jaxnav.detection.observe import observe
from jaxnav.drive.interfaces import Odometry
from jaxnav.drive.pilot import Input
from jaxnav.errors import BadInput
from jaxnav.files import load_topics, output_folder, save_vehicle
from jaxnav.files.ranges import is_within
from jaxnav.files.vehicles import as_car
from jaxnav.pictures.odometry import odometry_report
from jaxnav.recordings.drive_setup import DriveSetup
from jaxnav.recordings.other.recording import check_winding
from jaxnav.recordings.other.ros import read_ros_drive

_NONE = Detections.concatenate([])
_READING = np.dtype([("stamp_ns", np.int64), ("speed_mps", float), ("steering_rad", float)])
_VIEW = np.dtype(
    [
        ("stamp_ns", np.int64),
        ("camera", int),
        ("marker", int),
        ("corners_px", float, (4, 2)),
        ("sigma_px", float, 4),
    ]
)
_SHARED = ("rig", "markers", "vehicle")  # header keys that must agree in all recordings


@dataclass(frozen=True, eq=False)
class RecordedDrives:
    """Recorded drives, and the rig, map and vehicle that they were driven with.

    Attributes:
        files: all files that were read, in an order that does not change.
    """

    drives: tuple[Drive, ...]
    rig: CameraRig
    markers: MarkerMap
    vehicle: Vehicle
    files: tuple[Path, ...]


def run(args: Arguments) -> int:
    """Calibrate odometry, write vehicle.yaml and a report, and print a summary."""
    configure_jax(float64=True)
    recorded = read_recordings(args)
    before = {name: float(getattr(recorded.vehicle, name)) for name in NAMES}
    with progress_bar(unit="step", disable=args.headless, leave=False) as bar:
        calibration = calibrate_odometry(
            recorded.drives,
            recorded.rig,
            recorded.markers,
            before,
            args.fix,
            args.wheelbase_sigma_m,
            bar.update,
        )
    calibrated = provenance("odometry", recorded.files)
    out = output_folder(args.out)
    values: dict[str, Any] = dict(calibration.value)
    values["wheelbase_m"] = jnp.asarray(values["wheelbase_m"], recorded.vehicle.wheelbase_m.dtype)
    vehicle = replace(recorded.vehicle, **values)
    save_vehicle(out / "vehicle.yaml", vehicle, calibrated, calibration.sigma)
    poses = planar_in_world(calibration.poses, recorded.markers.origin_m)
    drawn, table = replace(calibration, poses=poses), _table(calibration)
    head = (
        f"{calibration.way_m:.1f} m in {calibration.duration_s:.0f} s, "
        f"{len(calibration.outliers)} views ({int(calibration.outliers.sum())} far off), "
        f"{calibration.rms_px:.2f} px RMS, chi-square "
        f"{calibration.chi2_per_dof:.2f} per degree of freedom"
    )
    lines = [head, *table]
    if left_out := sum(drive.left_out for drive in recorded.drives):
        lines.append(f"left out: {left_out} readings and views that are not finite, or of no car")
    lines += [f"next: {sentence}" for sentence in calibration.advice]
    report = calibrated.model_dump() | _report(args, recorded, calibration)
    figure = odometry_report(drawn, corners_in_world(recorded.markers), "\n".join(table))
    publish(out, report, figure, lines, ["vehicle.yaml"])
    return 0


def _report(
    args: Arguments, recorded: RecordedDrives, calibration: OdometryCalibration
) -> dict[str, Any]:
    speed_mps, steering_rad = np.abs(calibration.read[:, 0]), calibration.read[:, 1]
    return {
        "recordings": list(args.recordings),
        "reprojection_rms_px": calibration.rms_px,
        "chi2_per_dof": calibration.chi2_per_dof,
        "variance_inflation": calibration.inflation,
        "parameters": {
            name: {
                "value": calibration.value[name],
                "sigma": calibration.sigma.get(name),
                "before": calibration.before[name],
                "kept": calibration.fixed.get(name),
            }
            for name in NAMES
        },
        "correlation": {"of": list(calibration.sigma), "matrix": calibration.correlation},
        "reading_sigma": calibration.reading_sigma._asdict(),
        "coverage": {
            "duration_s": calibration.duration_s,
            "way_m": calibration.way_m,
            "views": len(calibration.outliers),
            "outliers": int(calibration.outliers.sum()),
            "speed_read_mps": [float(np.median(speed_mps)), float(np.percentile(speed_mps, 95))],
            "steering_read_rad": [float(q) for q in np.percentile(steering_rad, (5, 95))],
            "markers": sorted({recorded.markers.ids[m] for d in recorded.drives for m in d.marker}),
            "cameras": sorted({recorded.rig.names[c] for d in recorded.drives for c in d.camera}),
        },
        "advice": list(calibration.advice),
    }


def _table(calibration: OdometryCalibration) -> list[str]:
    """A line for each figure: before, found, one sigma."""
    lines = [f"{'':20}{'before':>10}{'found':>11}{'sigma':>10}"]
    for name in NAMES:
        sigma = f"{calibration.sigma[name]:10.5f}" if name in calibration.sigma else f"{'kept':>10}"
        before, value = calibration.before[name], calibration.value[name]
        lines.append(f"{name:20}{before:10.4f}{value:11.5f}{sigma}")
    return lines


# --- recordings ----------------------------------------------------------------------------


def read_recordings(args: Arguments) -> RecordedDrives:
    """Read all recordings and files of the command; JAX's precision must be set before.

    Raises:
        BadInput: names the file or the flag.
    """
    flags = dict(zip(_SHARED, (args.rig, args.markers, args.vehicle), strict=True))
    files = [file for path in args.recordings for file in _files(path)]
    files += [path for path in (*flags.values(), args.topics) if path is not None]
    inputs: Iterable[Iterable[Input]]
    sigma_px = None
    if args.topics is not None:
        given = given_files(args, _SHARED, bag=args.recordings[0])
        rig, markers, topics = given["rig"], given["markers"], load_topics(args.topics)
        vehicle = as_car(given["vehicle"], args.vehicle or "--vehicle")
        inputs = (
            read_ros_drive(path, topics, rig, markers, vehicle, args.corner_backend)
            for path in args.recordings
        )
    else:
        logs = []
        for path in args.recordings:
            if path.is_dir() or path.suffix != ".mcap":
                problem = "is no recording of jaxnav (.mcap): a ROS bag needs --topics"
                raise BadInput(path, problem)
            logs.append(read_shown(path, args.headless))
        first = logs[0]
        for log in logs[1:]:
            for key, flag in flags.items():
                if flag is None and log.header.get(key) != first.header.get(key):
                    problem = f"was driven with another {key} than {first.path}: say which by"
                    raise BadInput(log.path, f"{problem} --{key}")
        setup = DriveSetup.from_header(first.header, first.path)
        setup = replace(setup, **given_files(args, _SHARED))
        rig, markers, sigma_px = setup.rig, setup.markers, setup.corner_sigma_px
        vehicle = as_car(setup.vehicle, args.vehicle) if args.vehicle else setup.car(first.path)
        inputs = (log.inputs for log in logs)
    drives = [
        drive_of(str(path), of_drive, rig, markers, sigma_px)
        for path, of_drive in zip(args.recordings, inputs, strict=True)
    ]
    return RecordedDrives(tuple(drives), rig, markers, vehicle, tuple(files))


def drive_of(
    name: str,
    inputs: Iterable[Input],
    rig: CameraRig,
    markers: MarkerMap,
    corner_sigma_px: float | None = None,
) -> Drive:
    """The drive of a pilot's inputs: readings and views of markers, as the sensors gave them.

    Args:
        corner_sigma_px: of every corner along one axis; by default each detection's own.

    Raises:
        BadInput: corners are in another order than they should be.
    """
    left_out = 0
    detected_px = [np.zeros((0, 4, 2))]
    readings: list[tuple[int, float, float]] = []
    views: list[tuple[int, int, int, np.ndarray, np.ndarray]] = []
    looked: set[tuple[int, int]] = set()
    for given in inputs:
        if given.odometry is not None and given.odometry.valid:
            read = given.odometry
            if (
                isinstance(read, Odometry)
                and is_within("speed_mps", read.speed_mps)
                and is_within("steering_rad", read.steering_rad)
                and read.stamp_ns > 0
            ):
                readings.append((read.stamp_ns, read.speed_mps, read.steering_rad))
            else:
                left_out += 1
        for frame in given.frames:
            key = frame.camera, frame.stamp_ns
            if not frame.detections or key in looked or not 0 <= frame.camera < len(rig):
                continue
            looked.add(key)
            detected_px.append(frame.detections.corners_px)
            detections = [_NONE] * len(rig)
            detections[frame.camera] = frame.detections
            seen = observe(detections, markers)
            for marker in np.flatnonzero(seen.visible[frame.camera]):
                sigma_px = seen.sigma_px[frame.camera, marker]
                if corner_sigma_px is not None:
                    sigma_px = np.full(4, corner_sigma_px)
                corners_px = seen.corners_px[frame.camera, marker]
                known = is_within("corner_px", corners_px).all() and frame.stamp_ns > 0
                if known and is_within("seen_sigma_px", sigma_px).all():
                    views.append((frame.stamp_ns, frame.camera, int(marker), corners_px, sigma_px))
                else:
                    left_out += 1
    check_winding(name, np.concatenate(detected_px))
    reading, view = np.array(readings, _READING), np.array(views, _VIEW)
    return Drive(
        name, reading["stamp_ns"], reading["speed_mps"], reading["steering_rad"],
        view["stamp_ns"], view["camera"], view["marker"], view["corners_px"], view["sigma_px"],
        left_out,
    )  # fmt: skip


def _files(path: Path) -> list[Path]:
    """The files of a recording; a ROS 2 bag is a folder of several."""
    if not path.exists():
        raise BadInput(path, "there is no such recording")
    return sorted(file for file in path.rglob("*") if file.is_file()) if path.is_dir() else [path]
