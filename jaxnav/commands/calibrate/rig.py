"""`jaxnav calibrate rig`, `markers` and `check`: find the places of cameras and markers, of markers
with a rig that is calibrated, or those markers that are not where the map says."""

from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np

from jaxnav.calibrate.rig.calibrate import RigCalibration, calibrate_rig
from jaxnav.calibrate.rig.marker_check import Check, Verdict, checked, sizes_m
from jaxnav.calibrate.rig.vehicle_frame import driven_frame, moved_to_driven, moved_to_places
from jaxnav.calibrate.rig.views import Ts_vehicle_camera
from jaxnav.commands.calibrate.arguments import CalibrateCheck, CalibrateMarkers, CalibrateRig
from jaxnav.commands.calibrate.rig_data import RigData, RigResults, lines, read_rig_data
from jaxnav.commands.process import configure_jax
from jaxnav.commands.report import corners_in_world, publish
from jaxnav.errors import BadInput
from jaxnav.files import calib_dir, load_car, output_folder
from jaxnav.pictures.rig import map_check, rig_report

_WRONG_SCALE = 3.0  # ratio of found to given distances between cameras
_WRONG_SIZE = 1.5  # ratio of a marker's found to its given size
_APART_M = 0.05  # a smaller given distance is not compared
EXIT_WRONG = 1


def run(args: CalibrateRig | CalibrateMarkers | CalibrateCheck) -> int:
    """Find markers, and cameras where these are asked for; write files and print a summary.

    Returns:
        1 where a map that was to be checked is wrong, else 0.
    """
    configure_jax(float64=True)
    if isinstance(args, CalibrateCheck):
        return _check(args)
    data = read_rig_data(args, args.marker_size_m)
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
        raise BadInput(", ".join(map(str, args.recordings)), problem)
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
        raise BadInput(", ".join(map(str, args.recordings)), problem)

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


# --- check ---------------------------------------------------------------------------------


def _check(args: CalibrateCheck) -> int:
    """Compare the map with the recordings, and name wrong markers."""
    data = read_rig_data(args, only_known=True)
    if len(data.known) < 2:
        raise BadInput(
            args.markers or args.recordings[0],
            "one marker of the map was seen, two at least must be: nothing else can contradict it",
        )
    counts = np.bincount(data.views.marker, minlength=len(data.keys))
    anchor = max(data.known, key=lambda index: int(counts[index]))
    calibration = calibrate_rig(data.views, data.rig, {anchor: data.known[anchor]}, None)
    check = checked(
        calibration,
        data.views,
        data.rig,
        data.known,
        args.tolerance_m,
        np.deg2rad(args.tolerance_deg),
    )
    verdicts = check.verdicts
    all_right = all(verdict.right for verdict in verdicts.values())
    if all_right and sum(verdict.apart_m is not None for verdict in verdicts.values()) < 2:
        raise BadInput(
            args.recordings[0],
            "no two markers of the map are linked, so that nothing can contradict it: two must be "
            "in view at once now and then, by any cameras",
        )
    out = output_folder(args.out)
    # Covariances stay, as twists are body-fixed.
    move = check.T_map_world
    in_map = replace(
        calibration,
        Ts_world_marker=move @ calibration.Ts_world_marker,
        Ts_world_vehicle=move @ calibration.Ts_world_vehicle,
    )
    results = RigResults("check", data, in_map)
    report = results.report() | {
        "agreeing": check.agreeing,
        "verdicts": {" ".join(map(str, data.keys[i])): _as_json(v) for i, v in verdicts.items()},
    }
    mapped = results.mapped
    figure = map_check(
        given=np.stack([data.known[index] for index in mapped]),
        estimate=results.calibration.Ts_world_marker[mapped],
        size_m=data.views.size_m[mapped],
        ids=[data.keys[index][1] for index in mapped],
        wrong=[not verdicts[index].right for index in mapped],
    )
    publish(out, report, figure, _check_lines(data, check, all_right), results.save(out))
    return 0 if all_right else EXIT_WRONG


def _as_json(verdict: Verdict) -> dict[str, Any]:
    return {
        "right": verdict.right,
        "sightings": verdict.seen,
        "apart_m": verdict.apart_m,
        "apart_deg": None if verdict.apart_rad is None else np.rad2deg(verdict.apart_rad),
        "size_m": verdict.size_m,
        "wrong_size": verdict.wrong_size,
        "moved_m": verdict.moved_m,
    }


def _check_lines(data: RigData, check: Check, all_right: bool) -> Iterator[str]:
    yield f"{check.agreeing} of {len(check.verdicts)} markers agree with each other"
    for index, verdict in check.verdicts.items():
        for problem in _problems(float(data.views.size_m[index]), verdict):
            yield f"  marker {data.keys[index][1]}: {problem}"
    if all_right:
        yield "all markers that could be linked are where the map says"
    if check.agreeing < 2:
        yield "no two markers agree: which of them is right can't be told"


def _problems(map_m: float, verdict: Verdict) -> Iterator[str]:
    apart_m, apart_rad = verdict.apart_m, verdict.apart_rad
    if verdict.wrong_size:
        yield f"is {verdict.size_m:.4g} m large, the map says {map_m:.4g} m"
    if verdict.moved_m:
        yield f"moved by {verdict.moved_m:.3g} m while it was watched"
    if apart_m is None or apart_rad is None:
        if not (verdict.wrong_size or verdict.moved_m):
            yield f"seen {verdict.seen} times, nothing links it to the others"
    elif verdict.wrong:
        yield (
            f"is {apart_m:.3g} m and {np.rad2deg(apart_rad):.3g} deg from where the map says: it "
            "has moved, or was entered wrongly"
        )
