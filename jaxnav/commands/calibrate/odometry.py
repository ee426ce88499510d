"""`jaxnav calibrate odometry`: speed scale, steering, wheelbase and the cameras' delay."""

import dataclasses
import math
from typing import Any

import jax.numpy as jnp
import numpy as np

from jaxnav.calibrate.odometry.calibrate import OdometryCalibration, calibrate_odometry
from jaxnav.calibrate.odometry.model import NAMES
from jaxnav.commands.bars import progress_bar
from jaxnav.commands.calibrate.arguments import CalibrateOdometry as Arguments
from jaxnav.commands.calibrate.odometry_recordings import RecordedDrives, read_recordings
from jaxnav.commands.calibrate.report import provenance, publish
from jaxnav.commands.process import configure_jax
from jaxnav.commands.report import corners_in_world
from jaxnav.core.models.origin import planar_in_world
from jaxnav.files import output_folder, save_vehicle
from jaxnav.pictures.odometry import odometry_report


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
    vehicle = dataclasses.replace(recorded.vehicle, **values)
    save_vehicle(out / "vehicle.yaml", vehicle, calibrated, calibration.sigma)
    poses = planar_in_world(calibration.poses, recorded.markers.origin_m)
    drawn, table = dataclasses.replace(calibration, poses=poses), _table(calibration)
    lines = [_head(calibration), *table]
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


def _head(calibration: OdometryCalibration) -> str:
    """A line with distance, duration, views, and how well the fit explains them."""
    return (
        f"{calibration.way_m:.1f} m in {calibration.duration_s:.0f} s, "
        f"{len(calibration.outliers)} views ({int(calibration.outliers.sum())} far off), "
        f"{calibration.rms_px:.2f} px RMS, chi-square "
        f"{calibration.chi2_per_dof:.2f} per degree of freedom"
    )


def _table(calibration: OdometryCalibration) -> list[str]:
    """A line for each figure: before, found, one sigma."""
    lines = [f"{'':20}{'before':>10}{'found':>11}{'sigma':>10}"]
    for name in NAMES:
        sigma = calibration.sigma.get(name, math.nan)
        sigma_text = f"{sigma:10.5f}" if name in calibration.sigma else f"{'kept':>10}"
        lines.append(
            f"{name:20}{calibration.before[name]:10.4f}{calibration.value[name]:11.5f}{sigma_text}"
        )
    return lines
