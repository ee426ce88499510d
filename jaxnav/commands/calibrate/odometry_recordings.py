"""Recorded drives as data for the calibration of odometry."""

from collections.abc import Iterable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from jaxnav.calibrate.odometry.drive import Drive
from jaxnav.commands.calibrate.arguments import CalibrateOdometry as Arguments
from jaxnav.commands.reading import given_files, read_shown
from jaxnav.core.models.markers import MarkerMap
from jaxnav.core.models.rig import CameraRig
from jaxnav.core.models.vehicle import Vehicle
from jaxnav.detection import Detections
from jaxnav.detection.observe import observe
from jaxnav.drive.interfaces import Odometry
from jaxnav.drive.pilot import Input
from jaxnav.errors import BadInput
from jaxnav.files import load_topics
from jaxnav.files.ranges import is_within
from jaxnav.files.vehicles import as_car
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


def read_recordings(args: Arguments) -> RecordedDrives:
    """Read all recordings and files of the command; JAX's precision must be set before.

    Raises:
        BadInput: names the file or the flag.
    """
    given = [path for path in (args.rig, args.markers, args.vehicle) if path is not None]
    files = (*(file for path in args.recordings for file in _files(path)), *given)
    return _ros(args, files) if args.topics is not None else _own(args, files)


def _own(args: Arguments, files: tuple[Path, ...]) -> RecordedDrives:
    flags = dict(zip(_SHARED, (args.rig, args.markers, args.vehicle), strict=True))
    logs = []
    for path in args.recordings:
        if path.is_dir() or path.suffix != ".mcap":
            problem = "is no recording of jaxnav (.mcap): a ROS bag needs --topics"
            raise BadInput(path, problem)
        logs.append(read_shown(path, args.headless))
    for log in logs[1:]:
        for key in _SHARED:
            if flags[key] is None and log.header.get(key) != logs[0].header.get(key):
                problem = f"was driven with another {key} than {logs[0].path}: say which by --{key}"
                raise BadInput(log.path, problem)
    setup = DriveSetup.from_header(logs[0].header, logs[0].path)
    setup = replace(setup, **given_files(args, _SHARED))
    vehicle = (
        setup.car(logs[0].path) if args.vehicle is None else as_car(setup.vehicle, args.vehicle)
    )
    drives = [
        drive_of(str(log.path), log.inputs, setup.rig, setup.markers, setup.corner_sigma_px)
        for log in logs
    ]
    return RecordedDrives(tuple(drives), setup.rig, setup.markers, vehicle, files)


def _ros(args: Arguments, files: tuple[Path, ...]) -> RecordedDrives:
    assert args.topics is not None
    given = given_files(args, _SHARED, bag=args.recordings[0])
    topics = load_topics(args.topics)
    rig, markers = given["rig"], given["markers"]
    vehicle = as_car(given["vehicle"], args.vehicle or "--vehicle")
    drives = []
    for path in args.recordings:
        inputs = read_ros_drive(path, topics, rig, markers, vehicle, args.corner_backend)
        drives.append(drive_of(str(path), inputs, rig, markers))
    return RecordedDrives(tuple(drives), rig, markers, vehicle, (*files, args.topics))


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
