"""`jaxnav calibrate adopt`: what a drive has learnt, as a new rig and a new vehicle."""

import dataclasses
from importlib.metadata import version
from typing import Any

import jax.numpy as jnp
import jaxlie
import numpy as np

from jaxnav.commands.calibrate.arguments import CalibrateAdopt
from jaxnav.commands.pictures import save_figure
from jaxnav.commands.process import configure_jax
from jaxnav.commands.reading import given_files, read_shown
from jaxnav.errors import BadInput, visible
from jaxnav.files import output_folder, poses, save_rig, save_vehicle, write_json
from jaxnav.files.provenance import calibrated_now
from jaxnav.models.bicycle import SENSOR_ERRORS, Vehicle
from jaxnav.models.rig import CameraRig
from jaxnav.plots.learnt import learnt_over_time
from jaxnav.recording.drive_log import DriveLog
from jaxnav.recording.drive_setup import DriveSetup
from jaxnav.recording.learnt import Learnt

_SAME = 1e-5  # between two files of one rig, m and rad


def run(args: CalibrateAdopt) -> int:
    """Read what the drive has learnt, write it into new files, and print it."""
    configure_jax(float64=True)
    log = read_shown(args.recording, args.headless)
    setup = DriveSetup.of_header(log.header, log.path)
    given = given_files(args, ("rig", "vehicle"))
    _refuse_others(args, setup, given)
    rig, vehicle = given.get("rig", setup.rig), given.get("vehicle", setup.vehicle)
    index = _last_sure(log)
    errors, sigma = log.outcomes.errors, log.outcomes.errors_sigma
    learnt = Learnt.of(errors[index], sigma[index], setup.rig, setup.vehicle)
    assert learnt is not None  # _last_sure
    calibrated = calibrated_now(f"jaxnav {version('jaxnav')} calibrate adopt", [log.path])
    out = output_folder(args.out)
    written = []
    if setup.rig.extrinsics_sigma is not None:
        written.append("rig.yaml")
        save_rig(out / "rig.yaml", adopted_rig(rig, learnt), calibrated)
    if setup.vehicle.sensor_sigma is not None:
        told = dict(zip(SENSOR_ERRORS, learnt.sensors_sigma.tolist(), strict=True))
        written.append("vehicle.yaml")
        save_vehicle(out / "vehicle.yaml", adopted_vehicle(vehicle, learnt), calibrated, told)
    report = {
        "recording": str(log.path),
        "time_s": float(log.outcomes.times_s[index]),
        "sensors": _columns(SENSOR_ERRORS, learnt.sensors, learnt.sensors_sigma),
        "cameras_deg": _columns(
            setup.rig.names, np.rad2deg(learnt.turns_rad), np.rad2deg(learnt.turns_sigma_rad)
        ),
    }
    write_json(out / "report.json", calibrated.model_dump() | report)
    save_figure(learnt_over_time(log.outcomes, setup.rig, setup.vehicle), out / "report.png")
    for sentence in learnt.sentences() or ["nothing is off by three of its sigmas"]:
        print(visible(sentence))
    print(f"{', '.join([*written, 'report.json', 'report.png'])} in {visible(out)}")
    return 0


def adopted_rig(rig: CameraRig, learnt: Learnt) -> CameraRig:
    """The rig with its cameras turned in their places, each as sure as the drive was."""
    sigma = np.zeros((len(rig), 6))
    if rig.extrinsics_sigma is not None:
        sigma = np.asarray(rig.extrinsics_sigma, float)
    wxyz_xyz = np.asarray(rig.Ts_camera_vehicle.wxyz_xyz, float).copy()
    for camera, turn_rad in enumerate(learnt.turns_rad):
        turn = poses.pose_from_rotation_vector(turn_rad.tolist(), [0.0] * 3)
        T_vehicle_camera = poses.inverse(wxyz_xyz[camera])
        T_vehicle_camera[:4] = poses.quaternion_product(
            turn[:4].tolist(), T_vehicle_camera[:4].tolist()
        )
        wxyz_xyz[camera] = poses.inverse(T_vehicle_camera)
    return dataclasses.replace(
        rig,
        Ts_camera_vehicle=jaxlie.SE3(jnp.asarray(wxyz_xyz)),
        extrinsics_sigma=jnp.asarray(np.hstack([sigma[:, :3], learnt.turns_sigma_rad])),
    )


def adopted_vehicle(vehicle: Vehicle, learnt: Learnt) -> Vehicle:
    """The vehicle whose corrections of its sensors are followed by what the drive has learnt."""
    k, g, offset_rad, delay_s = (float(value) for value in learnt.sensors)
    return dataclasses.replace(
        vehicle,
        speed_scale=vehicle.speed_scale * (1 + k),
        steering_gain=vehicle.steering_gain * (1 + g),
        steering_offset_rad=vehicle.steering_offset_rad * (1 + g) + offset_rad,
        camera_delay_s=vehicle.camera_delay_s + delay_s,
    )


def _refuse_others(args: CalibrateAdopt, setup: DriveSetup, given: dict[str, Any]) -> None:
    """What was learnt corrects the files that the drive was driven with, and no others."""
    if "rig" in given:
        rig, driven = given["rig"], setup.rig
        place, driven_place = (
            np.asarray(one.Ts_camera_vehicle.wxyz_xyz, float) for one in (rig, driven)
        )
        if rig.names != driven.names or not np.allclose(place, driven_place, rtol=0, atol=_SAME):
            raise BadInput(args.rig, f"{args.recording} was driven with cameras in other places")
    if "vehicle" in given:
        figures, driven_figures = (
            [getattr(vehicle, name) for name in SENSOR_ERRORS]
            for vehicle in (given["vehicle"], setup.vehicle)
        )
        if not np.allclose(figures, driven_figures, rtol=0, atol=_SAME):
            raise BadInput(args.vehicle, f"{args.recording} was driven with other corrections")


def _last_sure(log: DriveLog) -> int:
    """The last outcome at which the bank knew where it was, and kept errors.

    Raises:
        BadInput: there is none.
    """
    outcomes = log.outcomes
    kept = np.isfinite(outcomes.errors).all(axis=1) & (outcomes.errors.shape[1] > 0)
    if not kept.any():
        problem = (
            "tells no errors of sensors and cameras: it was driven by a rule of one pose, with "
            "files that say they are exact, or recorded by an older jaxnav (`jaxnav replay "
            "--record-anew` makes another)"
        )
        raise BadInput(log.path, problem)
    sure = np.flatnonzero(kept & outcomes.located & outcomes.decided)
    if not sure.size:
        raise BadInput(log.path, "the drive never was sure of a pose: it has learnt nothing")
    return int(sure[-1])


def _columns(names: Any, values: np.ndarray, sigmas: np.ndarray) -> dict[str, Any]:
    rows = zip(names, values.tolist(), sigmas.tolist(), strict=True)
    return {name: {"value": value, "sigma": sigma} for name, value, sigma in rows}
