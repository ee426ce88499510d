"""`jaxnav calibrate adopt`: what a drive has learnt, as a new rig and a new vehicle."""

from typing import Any

import numpy as np

from jaxnav.commands.calibrate.arguments import CalibrateAdopt
from jaxnav.commands.process import configure_jax
from jaxnav.commands.reading import given_files, read_shown
from jaxnav.commands.report import provenance, publish
from jaxnav.core.models.vehicle import SENSOR_ERRORS
from jaxnav.errors import BadInput
from jaxnav.files import output_folder
from jaxnav.files.vehicles import as_car
from jaxnav.files.writing import atomic_write_all
from jaxnav.pictures.odometry import learnt_over_time
from jaxnav.recordings.adoption import (
    NEVER_SURE,
    NOTHING_KEPT,
    adopted_files,
    is_other_rig,
    is_other_vehicle,
)
from jaxnav.recordings.drive_log import DriveLog
from jaxnav.recordings.drive_setup import DriveSetup
from jaxnav.recordings.learnt import Learnt


def run(args: CalibrateAdopt) -> int:
    """Read what the drive has learnt, write it into new files, and print it."""
    configure_jax(float64=True)
    log = read_shown(args.recording, args.headless)
    setup = DriveSetup.from_header(log.header, log.path)
    vehicle = setup.car(log.path)
    given = given_files(args, ("rig", "vehicle"))
    # What was learnt corrects the files that the drive was driven with, and no others.
    if "rig" in given and is_other_rig(given["rig"], setup.rig):
        raise BadInput(args.rig, f"{args.recording} was driven with cameras in other places")
    if args.vehicle is not None and is_other_vehicle(
        as_car(given["vehicle"], args.vehicle), vehicle
    ):
        raise BadInput(args.vehicle, f"{args.recording} was driven with other corrections")
    index = _last_sure(log)
    errors, sigma = log.outcomes.errors, log.outcomes.errors_sigma
    learnt = Learnt.from_errors(errors[index], sigma[index], setup.rig, vehicle)
    assert learnt is not None  # _last_sure
    calibrated = provenance("adopt", [log.path])
    out = output_folder(args.out)
    texts = adopted_files(setup, learnt, calibrated, given.get("rig"), given.get("vehicle"))
    atomic_write_all({out / name: text for name, text in texts.items()})
    cameras_deg = np.rad2deg([learnt.turns_rad, learnt.turns_sigma_rad])
    report = calibrated.model_dump() | {
        "recording": str(log.path),
        "time_s": float(log.outcomes.times_s[index]),
        "sensors": _columns(SENSOR_ERRORS, learnt.sensors, learnt.sensors_sigma),
        "cameras_deg": _columns(setup.rig.names, *cameras_deg),
    }
    figure = learnt_over_time(log.outcomes, setup.rig, vehicle)
    lines = learnt.sentences() or ["nothing is off by three of its sigmas"]
    publish(out, report, figure, lines, texts)
    return 0


def _last_sure(log: DriveLog) -> int:
    """The last outcome at which the bank knew where it was, and kept errors."""
    outcomes = log.outcomes
    kept = np.isfinite(outcomes.errors).all(axis=1) & (outcomes.errors.shape[1] > 0)
    if not kept.any():
        older = "or recorded by an older jaxnav (`jaxnav replay --record-anew` makes another)"
        raise BadInput(log.path, f"{NOTHING_KEPT}, {older}")
    sure = np.flatnonzero(kept & outcomes.located & outcomes.decided)
    if not sure.size:
        raise BadInput(log.path, NEVER_SURE)
    return int(sure[-1])


def _columns(names: Any, values: np.ndarray, sigmas: np.ndarray) -> dict[str, Any]:
    rows = zip(names, values.tolist(), sigmas.tolist(), strict=True)
    return {name: {"value": value, "sigma": sigma} for name, value, sigma in rows}
