"""`jaxnav calibrate rig`: find the places of the cameras, and of the markers with them."""

from pathlib import Path

import numpy as np
from jaxtyping import Float

from jaxnav.calibrate.rig.calibrate import RigCalibration, calibrate_rig
from jaxnav.calibrate.rig.marker_check import sizes_m
from jaxnav.calibrate.rig.vehicle_frame import driven_frame, moved_to_driven, moved_to_places
from jaxnav.calibrate.rig.views import Ts_vehicle_camera
from jaxnav.commands.calibrate.arguments import CalibrateRig as Arguments
from jaxnav.commands.calibrate.data import RigData, read_rig_data
from jaxnav.commands.calibrate.report import (
    found_markers,
    provenance,
    summary,
    text,
    write_files,
)
from jaxnav.commands.pictures import corners_in_world, save_figure
from jaxnav.commands.process import configure_jax
from jaxnav.errors import BadInput, visible
from jaxnav.files import calib_dir, load_car, output_folder, write_json
from jaxnav.pictures.rig import rig_report

_WRONG_SCALE = 3.0  # ratio of found to given distances between cameras
_WRONG_SIZE = 1.5  # ratio of a marker's found to its given size
_APART_M = 0.05  # a smaller given distance is not compared


def run(args: Arguments) -> int:
    """Find cameras and markers, write the files, and print a summary."""
    configure_jax(float64=True)
    data = read_rig_data(args.recordings, args.rig, args.markers, args.marker_size_m, args.family)
    names = data.rig.names
    if len(names) < 2:
        problem = f"{names[0]} is the rig's only camera: `calibrate markers` finds the markers"
        raise BadInput(", ".join(map(str, args.recordings)), problem)
    ties = ("places", "drive", *names)
    if args.vehicle_frame not in ties:
        problem = f"must be one of {', '.join(ties)}, got {args.vehicle_frame!r}"
        raise BadInput("--vehicle-frame", problem)
    wheelbase_m = _wheelbase_m(args, data) if args.vehicle_frame == "drive" else 0.0
    reference = _reference_camera(args, data)
    given = Ts_vehicle_camera(data.rig)
    calibration = calibrate_rig(data.views, data.rig, data.known, reference, args.refine_lenses)
    _refuse_nonsense(args, data, calibration, given)
    calibration = _tied(args, data, calibration, given, wheelbase_m)
    publish(args.out, data, calibration, given, with_rig=True)
    return 0


def publish(
    folder: Path,
    data: RigData,
    calibration: RigCalibration,
    given: Float[np.ndarray, "C 4 4"],
    with_rig: bool,
) -> None:
    """Write all files, and print in a few lines what they hold.

    Args:
        given: (C, 4, 4) T_vehicle_camera before calibration.
        with_rig: whether cameras were calibrated, or markers alone.

    Raises:
        BadInput: a file can't be written.
    """
    out = output_folder(folder)
    calibrated = provenance(data, "rig" if with_rig else "markers")
    report = summary(data, calibration, given, calibrated)
    write_files(out, data, calibration, calibrated, with_rig)
    write_json(out / "report.json", report)
    markers, mapped = found_markers(data, calibration)
    ids = [data.keys[index][1] for index in mapped]
    figure = rig_report(calibration, data.rig, given, corners_in_world(markers), ids)
    save_figure(figure, out / "report.png")
    print(text(report))
    print(f"{'rig, markers' if with_rig else 'markers'} and report in {visible(out)}")


def _reference_camera(args: Arguments, data: RigData) -> int:
    """The index of the camera held fixed: the one that --vehicle-frame names, or that saw most."""
    if args.vehicle_frame in data.rig.names:
        return data.rig.names.index(args.vehicle_frame)
    return int(np.argmax(np.bincount(data.views.camera, minlength=len(data.rig))))


def refuse_wrong_sizes(data: RigData, calibration: RigCalibration) -> None:
    """Raise BadInput where a marker's size is far from the given one."""
    for index, size_m in sizes_m(calibration, data.views, data.rig).items():
        said_m = float(data.views.size_m[index])
        if not 1 / _WRONG_SIZE < size_m / said_m < _WRONG_SIZE:
            problem = (
                f"marker {data.keys[index][1]} looks {size_m:.3g} m large next to the others, and "
                f"{said_m:.3g} m was given: measure its black square, edge to edge, in m"
            )
            raise BadInput("size_m" if index in data.known else "--marker-size-m", problem)


def _refuse_nonsense(
    args: Arguments, data: RigData, calibration: RigCalibration, given: np.ndarray
) -> None:
    """Raise BadInput for wrong sizes, cameras that can't be linked, or a rig of another scale."""
    refuse_wrong_sizes(data, calibration)
    cameras = np.flatnonzero(calibration.calibrated)
    if len(cameras) < 2:
        problem = (
            "no two cameras could be linked: two of them must see the same markers, at once or one "
            "after the other while a third marker is in view; drive slowly around the markers"
        )
        raise BadInput(", ".join(map(str, args.recordings)), problem)

    def apart_m(Ts: np.ndarray) -> float:
        positions = Ts[cameras, :3, 3]
        return float(np.sqrt(np.mean(np.sum((positions - positions.mean(axis=0)) ** 2, axis=1))))

    was, is_now = apart_m(given), apart_m(calibration.Ts_vehicle_camera)
    if was > _APART_M and not 1 / _WRONG_SCALE < is_now / was < _WRONG_SCALE:
        problem = (
            f"the cameras come out {is_now / was:.1f} times as far apart as the rig says: is the "
            "size of the markers right (in m, edge to edge of the black square)?"
        )
        raise BadInput("--marker-size-m", problem)


def _wheelbase_m(args: Arguments, data: RigData) -> float:
    """The wheelbase, m, that a drive needs; refuses other recordings before any work is done."""
    vehicle = load_car(args.vehicle or calib_dir() / "qcar" / "vehicle.yaml")
    if len(data.parts) != 1 or not any(one.valid for one in data.parts[0].odometry):
        problem = "needs one recording, of a car's drive with odometry (a .mcap)"
        raise BadInput("--vehicle-frame drive", problem)
    return float(vehicle.wheelbase_m)


def _tied(
    args: Arguments,
    data: RigData,
    calibration: RigCalibration,
    given: np.ndarray,
    wheelbase_m: float,
) -> RigCalibration:
    """The calibration moved into the vehicle frame that --vehicle-frame asks for."""
    if args.vehicle_frame in data.rig.names:
        return calibration
    if args.vehicle_frame == "places":
        return moved_to_places(calibration, given)
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
