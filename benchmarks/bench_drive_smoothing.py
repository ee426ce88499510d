"""Smoothed drives against the truth: `python benchmarks/bench_drive_smoothing.py [--drives 20]`.

Drives of the simulated car through its pilot, 8 s each at 0.3 px, with other noise in each; what
the filter knew at every event, and what is known of it at the end (`jaxnav replay --smooth`).
"""

import argparse
from pathlib import Path

from jaxnav.files.configuration import configure

configure(float64=True)  # before the first array

import numpy as np  # noqa: E402

from jaxnav.files import Route, calib_dir, load_markers, load_rig, load_vehicle  # noqa: E402
from jaxnav.recordings.drive_events import DriveEvents  # noqa: E402
from jaxnav.recordings.drive_setup import DriveSetup  # noqa: E402
from jaxnav.recordings.other.localise import DriveTrack, distances, smooth_drive  # noqa: E402
from jaxnav.vehicles.conformance.faults import WAYPOINTS_M  # noqa: E402
from jaxnav.vehicles.conformance.lockstep import BEGIN_NS, drive  # noqa: E402
from jaxnav.vehicles.world import SimWorld  # noqa: E402

START = (2.0, -1.0, 2.2)


def errors_of(track: DriveTrack, truth: np.ndarray) -> np.ndarray:
    """Position m and heading rad off the truth, and over their sigmas: (N, 4)."""
    shift_m, turn_rad = distances(track.poses, truth, track.located)
    return np.stack([shift_m, turn_rad, shift_m / track.sigma_m, turn_rad / track.sigma_rad], 1)


def driven(setup: DriveSetup, seed: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Errors of the filtered and of the smoothed track, and where the filter had decided."""
    world = SimWorld(
        setup.rig, setup.markers, setup.vehicle, setup.route.start_pose, BEGIN_NS, seed=seed
    )
    steps = list(drive(setup.pilot(None), world, 8.0))
    events = DriveEvents.from_inputs([step.input for step in steps], setup, Path("drive"))
    filtered, smoothed = smooth_drive(events, setup)
    now_ns = [step.input.now_ns for step in steps]
    poses = np.array([step.truth[:3] for step in steps])
    poses[:, 2] = np.unwrap(poses[:, 2])
    truth = np.stack([np.interp(events.stamps_ns, now_ns, column) for column in poses.T], 1)
    return errors_of(filtered, truth), errors_of(smoothed, truth), filtered.decided


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--drives", type=int, default=20)
    qcar = calib_dir() / "qcar"
    setup = DriveSetup(
        load_rig(qcar / "rig.yaml"),
        load_markers(qcar / "markers.yaml"),
        load_vehicle(qcar / "vehicle.yaml"),
        Route(WAYPOINTS_M, 0.15, START),
        float64=True,
    )
    drives = [driven(setup, seed) for seed in range(parser.parse_args().drives)]
    filtered, smoothed, decided = (np.concatenate(parts) for parts in zip(*drives, strict=True))
    print("| | RMS cm | 95 % cm | RMS deg | inside 3 sigma | before it had decided, RMS cm |")
    print("|---|---|---|---|---|---|")
    for name, errors in (("filter", filtered), ("smoothed", smoothed)):
        shift_m, turn_rad, *shares = errors[decided].T
        inside = min(np.mean(share < 3) for share in shares)
        early_m = errors[~decided, 0]
        print(
            f"| {name} | {100 * np.sqrt(np.mean(shift_m**2)):.2f} "
            f"| {100 * np.percentile(shift_m, 95):.2f} "
            f"| {np.rad2deg(np.sqrt(np.mean(turn_rad**2))):.3f} "
            f"| {inside:.1%} | {100 * np.sqrt(np.mean(early_m**2)):.2f} |"
        )


if __name__ == "__main__":
    main()
