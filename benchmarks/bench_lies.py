"""How far a vehicle goes on a lie of its motion or its files; how often a sound one is blamed.

    python benchmarks/bench_lies.py [--base ackermann|differential|omni] [--imu NAME] [--seeds N]
    python benchmarks/bench_lies.py --clean N [--first-seed 1000] [--base ...]

Lockstep drives of the fault matrix' rows of lies, N seeds each, as a table; or N sound drives, each
with a start, a route, wheels and corners of its own, in which no fault of these may be told.
"""

import argparse
import dataclasses
import math
from collections import Counter

import numpy as np
from tqdm import tqdm

from jaxnav.drive.compiled_step import compile_or_load
from jaxnav.drive.estimator import advance_packed
from jaxnav.drive.flags import Fault, names
from jaxnav.files import calib_dir, load_markers, load_rig, load_vehicle
from jaxnav.files.configuration import configure, step_folder
from jaxnav.sim.bases import BASES, IMUS, equipped
from jaxnav.sim.plant import OdometryNoise
from jaxnav.vehicles.conformance import injections as inject
from jaxnav.vehicles.conformance.faults import HEADER, FaultRow, Trial, line, run_trial
from jaxnav.vehicles.conformance.matrix import MATRIX
from jaxnav.vehicles.world import WorldSettings

LIES = (
    Fault.DRIVE_CONTRADICTED | Fault.SIDEWAYS_CONTRADICTED | Fault.TURN_CONTRADICTED
    | Fault.GYRO_CONTRADICTED | Fault.GYRO_INVALID | Fault.LEFT_ROUTE
    | Fault.FILES_CONTRADICTED | Fault.DUPLICATE_MARKER | Fault.CORNERS_MIRRORED
)  # fmt: skip
TUNNEL = inject.frames(inject.nothing_seen)


def sound(trial: Trial, seed: int) -> Trial:
    """A drive of its own, with errors as large as those of the scenarios of `jaxnav simulate`."""
    rng = np.random.default_rng(seed)
    odometry = OdometryNoise(
        speed_scale=rng.choice([1.0, 0.9, 1.1, 1.3]),
        steering_offset_rad=math.radians(rng.uniform(-1, 1)),
        turn_scale=rng.uniform(0.95, 1.05),
        turn_offset_radpm=rng.uniform(-0.03, 0.03),
        spin=rng.choice([0.0, 0.5]),
    )
    settings = WorldSettings(rng.uniform(0.2, 1.0), odometry, rng.uniform(0.0, 0.1))
    places_m = [tuple(place) for place in rng.uniform([-1.3, -1.7], [1.3, 0.2], (14, 2)).tolist()]
    x_m, y_m = rng.uniform([-1.8, -1.5], [1.8, -0.2])
    return dataclasses.replace(
        trial,
        start_pose=(x_m, y_m, rng.uniform(-math.pi, math.pi)),
        waypoints_m=tuple(places_m),
        seed=seed,
        settings=settings,
    )


def main() -> None:
    """Drive, and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--base", choices=BASES, default="ackermann")
    parser.add_argument("--imu", choices=IMUS, default="none")
    parser.add_argument("--seeds", type=int, default=1)
    parser.add_argument("--clean", type=int, default=0)
    parser.add_argument("--first-seed", type=int, default=0)
    args = parser.parse_args()
    configure(float64=False, threads=1)
    qcar = calib_dir() / "qcar"
    trial = Trial(
        load_rig(qcar / "rig.yaml"),
        load_markers(qcar / "markers.yaml"),
        equipped(load_vehicle(qcar / "vehicle.yaml"), args.base, args.imu),
        program=lambda navigator: compile_or_load(advance_packed, navigator, step_folder()),
    )
    seeds = range(args.first_seed, args.first_seed + (args.clean or args.seeds))
    if args.clean:
        told: Counter[str] = Counter()
        for seed in tqdm(seeds, mininterval=10):
            tunnel = inject.between(4.0, 7.0, TUNNEL) if seed % 2 else lambda given: [given]
            row = FaultRow("sound", lambda tunnel=tunnel: tunnel, begins_s=0.0, drive_s=12.0)
            result = run_trial(row, sound(trial, seed))
            told.update(names(result.faults & LIES))
            if result.faults & LIES:
                print(seed, line(result), flush=True)
        print(f"{args.clean} sound drives: {dict(told) or 'nothing told'}")
        return
    print(HEADER)
    for row in MATRIX:
        if row.suits(trial) and row.faults & LIES:
            for seed in seeds:
                print(line(run_trial(row, dataclasses.replace(trial, seed=seed))), flush=True)


if __name__ == "__main__":
    main()
