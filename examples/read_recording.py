"""Read a recorded drive, print what is in it, and run its inputs again by another selector.

    python examples/read_recording.py [drive.mcap [selector]]     # as `jaxnav run` writes it

With the selector of the recording the replay has the same bits (`jaxnav replay` checks it). With
another one the car still goes where it went; only what the pilot makes of it differs.
"""

import dataclasses
import sys
from pathlib import Path

import numpy as np

from jaxnav.drive.flags import Health
from jaxnav.recordings.drive_log import read_drive
from jaxnav.recordings.drive_replay import replay_drive
from jaxnav.recordings.drive_setup import DriveSetup

DRIVE = Path(__file__).resolve().parents[1] / "tests" / "data" / "drives" / "plain.mcap"


def main(path: str | Path = DRIVE, selector: str = "paper-cost") -> dict[str, float]:
    """Returns: how many inputs and frames with markers, and how far apart the poses are."""
    log = read_drive(path)
    setup, recorded = DriveSetup.from_header(log.header, Path(path)), log.outcomes
    odometry = [given.odometry for given in log.inputs if given.odometry]
    frames = [frame for given in log.inputs for frame in given.frames if frame.detections]
    speed_mps = max(reading.speed_mps for reading in odometry)
    print(f"{Path(path).name}: {recorded.times_s[-1]:.1f} s, {len(log.inputs)} inputs")
    print(f"{len(odometry)} readings of the odometer, up to {speed_mps:.2f} m/s")
    print(f"{len(frames)} frames that show markers, of cameras {', '.join(setup.rig.names)}")
    print(f"at its end {Health(recorded.health[-1]).name}, {recorded.restarts[-1]} restarts")

    other = dataclasses.replace(setup, selector=selector)
    anew = list(replay_drive(log.inputs, other, folder=None))
    poses = np.array([outcome.pose for outcome in anew])
    apart_m = np.linalg.norm((poses - recorded.pose)[:, :2], axis=1)
    print(f"{selector} instead of {setup.selector}: {anew[-1].restarts} restarts, poses", end=" ")
    print(f"{100 * np.nanmedian(apart_m):.1f} cm apart, {100 * apart_m[-1]:.1f} cm at the end")
    return {
        "inputs": len(log.inputs),
        "frames": len(frames),
        "restarts": int(recorded.restarts[-1]),
        "apart_m": float(apart_m[-1]),
    }


if __name__ == "__main__":
    main(*sys.argv[1:3])
