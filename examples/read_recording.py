"""Read a recorded drive, print what is in it, and localise anew from what its sensors told.

    python examples/read_recording.py [drive.mcap]       # as `jaxnav run` writes it

`jaxnav replay` runs the whole pilot again, bit for bit; here `Navigator.step` alone goes through
the events, in the order in which they were measured.
"""

import sys
from pathlib import Path

import jax.numpy as jnp
import numpy as np

import jaxnav as jn
from jaxnav.detection.observe import observe
from jaxnav.detection.types import Detections
from jaxnav.files import calib_dir
from jaxnav.loop.flags import Health
from jaxnav.navigator import jitted_step
from jaxnav.recording.drive_log import read_drive
from jaxnav.recording.drive_setup import DriveSetup

DRIVE = Path(__file__).resolve().parents[1] / "tests" / "data" / "drives" / "plain.mcap"


def main(path: str | Path = DRIVE) -> dict[str, float]:
    """Returns: how many inputs, frames with markers, and how far the two last poses are apart."""
    log = read_drive(path)
    setup, outcomes = DriveSetup.of_header(log.header, Path(path)), log.outcomes
    odometry = [given.odometry for given in log.inputs if given.odometry]
    frames = [frame for given in log.inputs for frame in given.frames if frame.detections]
    print(f"{Path(path).name}: {outcomes.times_s[-1]:.1f} s, {len(log.inputs)} inputs")
    print(f"{len(odometry)} readings of the odometer, up to", end=" ")
    print(f"{max(reading.speed_mps for reading in odometry):.2f} m/s")
    print(f"{len(frames)} frames that show markers, of cameras {', '.join(setup.rig.names)}")
    print(f"at its end {Health(outcomes.health[-1]).name}, {outcomes.restarts[-1]} restarts")

    # A frame is known some time after it was taken: by the stamps it stands where it belongs.
    events = [(reading.stamp_ns, reading, ()) for reading in odometry if reading.valid]
    for given in log.inputs:
        shown = tuple(frame for frame in given.frames if frame.detections)
        if shown:
            events.append((shown[0].stamp_ns, None, shown))
    events.sort(key=lambda event: event[0])

    route = jn.load_route(calib_dir() / "qcar" / "route.yaml")  # where to is of no matter here
    navigator = jn.Navigator(setup.rig, setup.markers, setup.vehicle, route.waypoints_m)
    state, before_ns, told = navigator.init(), events[0][0], np.zeros(2)
    dtype = navigator.corner_sigma_px.dtype
    for stamp_ns, reading, shown in events:
        found = [Detections.concatenate([])] * len(setup.rig)
        for frame in shown:
            found[frame.camera] = frame.detections
        seen = observe(found, setup.markers)
        if reading is not None:
            told = np.array([reading.speed_mps, reading.steering_rad])
        numbers = np.array([*told, (stamp_ns - before_ns) / 1e9], dtype)
        sensed = seen.corners_px.astype(dtype), seen.visible, *numbers
        obs = jn.Observation(*map(jnp.asarray, sensed))
        state, out = jitted_step(navigator, state, obs)
        before_ns = stamp_ns
    apart_m = float(np.linalg.norm(out.pose[:2] - outcomes.pose[-1, :2]))
    print(f"localised anew: {100 * apart_m:.1f} cm from the recorded pose, decided {out.decided}")
    return {
        "inputs": len(log.inputs),
        "frames": len(frames),
        "restarts": int(outcomes.restarts[-1]),
        "decided": bool(out.decided),
        "apart_m": apart_m,
    }


if __name__ == "__main__":
    main(*sys.argv[1:2])
