"""`jaxnav calibrate rig` and `markers`: find the places of cameras and markers, or of markers
with a rig that is calibrated."""

from pathlib import Path

import numpy as np

from jaxnav.calibrate.rig.calibrate import RigCalibration, calibrate_rig
from jaxnav.calibrate.rig.marker_check import sizes_m
from jaxnav.calibrate.rig.vehicle_frame import driven_frame, moved_to_driven, moved_to_places
from jaxnav.calibrate.rig.views import Ts_vehicle_camera
from jaxnav.commands.calibrate.arguments import CalibrateMarkers, CalibrateRig
from jaxnav.commands.calibrate.data import RigData, read_rig_data
from jaxnav.commands.calibrate.report import publish
from jaxnav.commands.calibrate.rig_results import RigResults, lines
from jaxnav.commands.process import configure_jax
from jaxnav.commands.report import corners_in_world
from jaxnav.errors import BadInput
from jaxnav.files import calib_dir, load_car, output_folder
from jaxnav.pictures.rig import rig_report

_WRONG_SCALE = 3.0  # ratio of found to given distances between cameras
_WRONG_SIZE = 1.5  # ratio of a marker's found to its given size
_APART_M = 0.05  # a smaller given distance is not compared


def run(args: CalibrateRig | CalibrateMarkers) -> int:
    """Find the markers, and the cameras where these are asked for; write files; print a summary."""
    configure_jax(float64=True)
    data = read_rig_data(args.recordings, args.rig, args.markers, args.marker_size_m, args.family)
    if isinstance(args, CalibrateRig):
        calibration = _find_cameras(args, data)
    else:
        calibration = calibrate_rig(data.views, data.rig, data.known, None)
        _refuse_wrong_sizes(data, calibration)
    out = output_folder(args.out)
    results = RigResults("rig" if isinstance(args, CalibrateRig) else "markers", data, calibration)
    files, report, markers = results.save(out), results.report(), results.markers
    figure = rig_report(
        calibration, data.rig, Ts_vehicle_camera(data.rig), corners_in_world(markers), markers.ids
    )
    publish(out, report, figure, lines(report), files)
    return 0


def _find_cameras(args: CalibrateRig, data: RigData) -> RigCalibration:
    names = data.rig.names
    if len(names) < 2:
        problem = f"{names[0]} is the rig's only camera: `calibrate markers` finds the markers"
        raise BadInput(_listed(args.recordings), problem)
    ties = ("places", "drive", *names)
    if args.vehicle_frame not in ties:
        problem = f"must be one of {', '.join(ties)}, got {args.vehicle_frame!r}"
        raise BadInput("--vehicle-frame", problem)
    wheelbase_m = _wheelbase_m(args, data) if args.vehicle_frame == "drive" else 0.0
    # Held fixed is the camera that --vehicle-frame names, or that saw most.
    reference = int(np.argmax(np.bincount(data.views.camera, minlength=len(names))))
    if args.vehicle_frame in names:
        reference = names.index(args.vehicle_frame)
    calibration = calibrate_rig(data.views, data.rig, data.known, reference, args.refine_lenses)
    _refuse_wrong_sizes(data, calibration)
    _refuse_unlinked(args, data, calibration)
    if args.vehicle_frame == "drive":
        return _tied_to_drive(data, calibration, wheelbase_m)
    if args.vehicle_frame == "places":
        return moved_to_places(calibration, Ts_vehicle_camera(data.rig))
    return calibration


def _listed(recordings: tuple[Path, ...]) -> str:
    return ", ".join(map(str, recordings))


def _refuse_wrong_sizes(data: RigData, calibration: RigCalibration) -> None:
    """Raise BadInput where a marker's size is far from the given one."""
    for index, size_m in sizes_m(calibration, data.views, data.rig).items():
        said_m = float(data.views.size_m[index])
        if not 1 / _WRONG_SIZE < size_m / said_m < _WRONG_SIZE:
            problem = (
                f"marker {data.keys[index][1]} looks {size_m:.3g} m large next to the others, and "
                f"{said_m:.3g} m was given: measure its black square, edge to edge, in m"
            )
            raise BadInput("size_m" if index in data.known else "--marker-size-m", problem)


def _refuse_unlinked(args: CalibrateRig, data: RigData, calibration: RigCalibration) -> None:
    """Raise BadInput for cameras that can't be linked, or a rig of another scale."""
    cameras = np.flatnonzero(calibration.calibrated)
    if len(cameras) < 2:
        problem = (
            "no two cameras could be linked: two of them must see the same markers, at once or one "
            "after the other while a third marker is in view; drive slowly around the markers"
        )
        raise BadInput(_listed(args.recordings), problem)

    def apart_m(Ts: np.ndarray) -> float:
        positions = Ts[cameras, :3, 3]
        return float(np.sqrt(np.mean(np.sum((positions - positions.mean(axis=0)) ** 2, axis=1))))

    was = apart_m(Ts_vehicle_camera(data.rig))
    is_now = apart_m(calibration.Ts_vehicle_camera)
    if was > _APART_M and not 1 / _WRONG_SCALE < is_now / was < _WRONG_SCALE:
        problem = (
            f"the cameras come out {is_now / was:.1f} times as far apart as the rig says: is the "
            "size of the markers right (in m, edge to edge of the black square)?"
        )
        raise BadInput("--marker-size-m", problem)


def _wheelbase_m(args: CalibrateRig, data: RigData) -> float:
    """The wheelbase, m, that a drive needs; refuses other recordings before any work is done."""
    vehicle = load_car(args.vehicle or calib_dir() / "qcar" / "vehicle.yaml")
    if len(data.parts) != 1 or not any(one.valid for one in data.parts[0].odometry):
        problem = "needs one recording, of a car's drive with odometry (a .mcap)"
        raise BadInput("--vehicle-frame drive", problem)
    return float(vehicle.wheelbase_m)


def _tied_to_drive(
    data: RigData, calibration: RigCalibration, wheelbase_m: float
) -> RigCalibration:
    """The calibration moved into the vehicle frame that the drive's odometry tells."""
    readings = (one for one in data.parts[0].odometry if one.valid)
    odometry = sorted(readings, key=lambda one: one.stamp_ns)
    start_ns = calibration.views.stamps_ns[0]
    driven = driven_frame(
        (calibration.views.stamps_ns - start_ns) / 1e9,
        calibration.Ts_world_vehicle,
        np.array([(one.stamp_ns - start_ns) / 1e9 for one in odometry]),
        np.array([one.speed_mps for one in odometry]),
        np.array([one.steering_rad for one in odometry]),
        wheelbase_m,
    )
    return moved_to_driven(calibration, driven)
