"""Write rig and vehicle files corrected by what a drive has learnt.

texts = adopted_files(setup, learnt, calibrated)     # {"rig.yaml": ..., "vehicle.yaml": ...}
"""

import dataclasses
from pathlib import Path

import jax.numpy as jnp
import jaxlie
import numpy as np

from jaxnav.core.models.rig import CameraRig
from jaxnav.core.models.vehicle import SENSOR_ERRORS, Vehicle
from jaxnav.files import poses
from jaxnav.files.provenance import Calibrated, file_text
from jaxnav.files.rigs import rig_data
from jaxnav.files.vehicles import vehicle_data
from jaxnav.recordings.drive_setup import DriveSetup
from jaxnav.recordings.learnt import Learnt

NOTHING_KEPT = (
    "tells no errors of sensors and cameras: it was driven by a rule of one pose, with "
    "files that say they are exact"
)
NEVER_SURE = "the drive never was sure of a pose: it has learnt nothing"
_SAME = 1e-5  # between two files of one rig, m and rad


def adopted_files(
    setup: DriveSetup,
    learnt: Learnt,
    calibrated: Calibrated,
    rig: CameraRig | None = None,
    vehicle: Vehicle | None = None,
) -> dict[str, str]:
    """The new files by their names, of what a drive of a car with this setup keeps errors of.

    As exact as they are learnt only in a process, or a block, of double precision.

    Args:
        rig, vehicle: what is corrected, see `is_other_rig`; by default what was driven with.
    """
    texts = {}
    if setup.rig.extrinsics_sigma is not None:
        texts["rig.yaml"] = file_text(rig_data(adopted_rig(rig or setup.rig, learnt)), calibrated)
    if setup.vehicle.sensor_sigma is not None:
        sigma = dict(zip(SENSOR_ERRORS, learnt.sensors_sigma.tolist(), strict=True))
        adopted = adopted_vehicle(vehicle or setup.car(Path("DriveSetup")), learnt)
        texts["vehicle.yaml"] = file_text(vehicle_data(adopted, sigma), calibrated)
    return texts


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


def is_other_rig(rig: CameraRig, driven: CameraRig) -> bool:
    """Whether the cameras are others than those driven with, or in other places: what was learnt
    corrects no others."""
    place, driven_place = (
        np.asarray(one.Ts_camera_vehicle.wxyz_xyz, float) for one in (rig, driven)
    )
    return rig.names != driven.names or not np.allclose(place, driven_place, rtol=0, atol=_SAME)


def is_other_vehicle(vehicle: Vehicle, driven: Vehicle) -> bool:
    """Whether the vehicle has other corrections of its sensors than the one driven with."""
    figures, driven_figures = (
        [getattr(one, name) for name in SENSOR_ERRORS] for one in (vehicle, driven)
    )
    return not np.allclose(figures, driven_figures, rtol=0, atol=_SAME)
