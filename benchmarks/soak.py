"""A million events through the pilot: does anything grow, drift or break?

    python benchmarks/soak.py [--events N] [--float64]

A drive of the simulated car is recorded once, twenty seconds of odometry and frames, and then
played to one pilot again and again, time going on: at every seam the car is somewhere else, so the
pilot has to find out and start anew, hundreds of times. Printed: memory, traces, health,
covariance.
"""

import argparse
import dataclasses
import resource
import time
from pathlib import Path

import jax
import numpy as np
from tqdm import tqdm

from jaxnav.core.navigator import Navigator
from jaxnav.drive.estimator import advance_packed
from jaxnav.drive.flags import Fault, Health
from jaxnav.drive.pilot import Input, Pilot
from jaxnav.files import calib_dir, load_markers, load_rig, load_vehicle
from jaxnav.files.configuration import configure
from jaxnav.vehicles.conformance.faults import WAYPOINTS_M
from jaxnav.vehicles.conformance.lockstep import BEGIN_NS, drive
from jaxnav.vehicles.world import SimWorld

RECORDED_S = 20.0


def rss_mib() -> float:
    """Memory of this process, MiB."""
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * resource.getpagesize() / 2**20


def later(given: Input, by_ns: int) -> Input:
    """The same input at another time."""
    reading = given.odometry
    if reading is not None:
        reading = dataclasses.replace(reading, stamp_ns=reading.stamp_ns + by_ns)
    frames = tuple(dataclasses.replace(f, stamp_ns=f.stamp_ns + by_ns) for f in given.frames)
    return Input(given.now_ns + by_ns, reading, frames, given.faults)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--events", type=int, default=1_000_000)
    parser.add_argument("--float64", action="store_true")
    args = parser.parse_args()
    configure(float64=args.float64, threads=1)
    qcar = calib_dir() / "qcar"
    rig, markers = load_rig(qcar / "rig.yaml"), load_markers(qcar / "markers.yaml")
    vehicle = load_vehicle(qcar / "vehicle.yaml")
    navigator = Navigator(
        rig=rig, markers=markers, vehicle=vehicle, waypoints_m=WAYPOINTS_M, waypoint_radius_m=0.15
    )
    traces = 0

    @jax.jit
    def program(*told):
        nonlocal traces
        traces += 1
        return advance_packed(navigator, *told)

    world = SimWorld(rig, markers, vehicle, (2.0, -1.0, np.deg2rad(125.0)), BEGIN_NS)
    recorder = Pilot(navigator, program=program)
    inputs = [step.input for step in drive(recorder, world, RECORDED_S)]
    span_ns = inputs[-1].now_ns - inputs[0].now_ns + 20_000_000
    pilot = Pilot(navigator, program=program)
    healths, not_finite, least, largest, asymmetry = np.zeros(6, int), 0, np.inf, 0.0, 0.0
    memory: list[float] = []
    begin_s = time.monotonic()
    with tqdm(total=args.events, unit="event") as bar:
        for count in range(args.events):
            lap, index = divmod(count, len(inputs))
            outcome = pilot.handle(later(inputs[index], lap * span_ns))
            healths[outcome.health] += 1
            not_finite += Fault.NOT_FINITE in outcome.faults
            if outcome.output.located:
                P = outcome.output.covariance
                eigenvalues = np.linalg.eigvalsh(P.astype(float))
                least, largest = min(least, eigenvalues[0]), max(largest, eigenvalues[-1])
                asymmetry = max(asymmetry, float(np.abs(P - P.T).max()))
            if count % 10_000 == 9_999:
                memory.append(rss_mib())
            bar.update()
    seconds = time.monotonic() - begin_s
    shares = {health.name: f"{healths[health] / args.events:.1%}" for health in Health}
    print(
        f"{'float64' if args.float64 else 'float32'}: {args.events} events, "
        f"{1e3 * seconds / args.events:.2f} ms each; traces {traces}; not finite {not_finite}; "
        f"restarts {outcome.restarts}; eigenvalues of P {least:.1e} to {largest:.1e}, "
        f"asymmetry {asymmetry:.1e}; health {shares}"
    )
    if len(memory) > 4:
        quarter = max(len(memory) // 4, 1)
        print(
            f"memory: {np.median(memory[quarter : 2 * quarter]):.1f} MiB in the second quarter, "
            f"{np.median(memory[-quarter:]):.1f} MiB in the last"
        )


if __name__ == "__main__":
    main()
