"""What calibrating odometry reaches, as tables: `python -m benchmarks.bench_odometry [trials]
[drives]`, both by default.

`trials`: 160 cars, each off in its own way, on the drive that calib/README.md asks for; errors
against 1 %, and whether they are as large as they say of themselves. `drives`: one car on others.
"""

import argparse
import math
import time
from collections.abc import Callable

import numpy as np
from tqdm import tqdm

from jaxnav.calibrate.odometry.calibrate import OdometryCalibration, calibrate_odometry
from jaxnav.calibrate.odometry.model import NAMES
from jaxnav.errors import BadInput
from jaxnav.files import calib_dir, load_markers, load_rig
from jaxnav.files.configuration import configure
from jaxnav.sim.statistics import anees_band
from tests.helpers.odometry_drives import (
    RECIPE,
    START,
    TRUTH,
    Leg,
    Sensors,
    eights,
    sensed,
    true_track,
)

# Noise of the corners (px), share of views that are something else, cars.
TRIALS = ((0.3, 0.0, 100), (1.0, 0.0, 30), (0.3, 0.02, 30))
DURATION_S = 60.0
BEFORE = dict(zip(NAMES, (1.0, 1.0, 0.0, 0.256, 0.0), strict=True))
# How far cars are off: half the width of what is drawn evenly, about what follows.
SPREAD = np.array([0.1, 0.1, 0.03, 0.01, 0.04])
MIDDLE = np.array([1.0, 1.0, 0.0, 0.256, 0.02])


def main() -> None:
    """Print the tables that are asked for."""
    configure(float64=True)
    sections: dict[str, Callable[[], None]] = {"trials": trials_table, "drives": drives_table}
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("sections", nargs="*", help=", ".join(sections))
    for name in parser.parse_args().sections or sections:
        print(f"\n## {name}\n", flush=True)
        sections[name]()


def allowed(theta: np.ndarray) -> np.ndarray:
    """1 % of a figure; of the steering's limit (0.5 rad) for its offset; 1 ms for the delay."""
    return np.array([0.01 * theta[0], 0.01 * theta[1], 0.005, 0.01 * theta[3], 0.001])


def calibrated(
    legs: list[Leg],
    theta: np.ndarray,
    seed: int,
    sensors: Sensors,
    start: tuple[float, float, float] = START,
) -> OdometryCalibration:
    """Of one drive."""
    rig = load_rig(calib_dir() / "qcar" / "rig.yaml")
    markers = load_markers(calib_dir() / "qcar" / "markers.yaml")
    track = true_track(legs, DURATION_S, theta, start)
    return calibrate_odometry(
        [sensed(track, rig, markers, seed, theta, sensors)], rig, markers, BEFORE
    )


def trials_table() -> None:
    """Errors and consistency of many cars, at two noises of the corners."""
    for corner_sigma_px, wrong_share, trials in TRIALS:
        errors, sigmas, nees, chi2, refused = [], [], [], [], 0
        began_s = time.perf_counter()
        for seed in tqdm(range(trials), leave=False):
            rng = np.random.default_rng([seed, 1])
            theta = MIDDLE + SPREAD * rng.uniform(-1, 1, 5)
            sensors = Sensors(corner_sigma_px, wrong_share=wrong_share)
            try:
                found = calibrated(RECIPE, theta, seed, sensors)
            except BadInput as problem:
                print(f"seed {seed}: {problem}")
                refused += 1
                continue
            error = np.array([found.value[name] for name in NAMES]) - theta
            sigma = np.array([found.sigma[name] for name in NAMES])
            covariance = found.correlation * np.outer(sigma, sigma)
            errors.append(error / allowed(theta))
            sigmas.append(error / sigma)
            nees.append(error @ np.linalg.solve(covariance, error))
            chi2.append(found.chi2_per_dof)
        seconds = (time.perf_counter() - began_s) / trials
        _print_trials(np.array(errors), np.array(sigmas))
        low, high = anees_band(len(nees), 5)
        print(
            f"\ncorners {corner_sigma_px} px, {wrong_share:.0%} wrong: ANEES {np.mean(nees):.2f} "
            f"(consistent: {low:.2f} to {high:.2f}), chi-square per degree of freedom "
            f"{np.mean(chi2):.3f}, {refused} refused, {seconds:.1f} s a drive\n",
            flush=True,
        )


def _print_trials(parts: np.ndarray, z: np.ndarray) -> None:
    print("| figure | median error, in parts of what is allowed | largest | z, std | in 3 sigma |")
    print("|---|---|---|---|---|")
    for column, name in enumerate(NAMES):
        part, own = np.abs(parts[:, column]), z[:, column]
        inside = int(np.sum(np.abs(own) <= 3))
        print(
            f"| {name} | {np.median(part):.3f} | {part.max():.3f} | {own.std():.2f} | "
            f"{inside} of {len(own)} |"
        )


def drives_table() -> None:
    """How sure each figure is after a minute of one kind of driving."""
    straight = -TRUTH[2] / TRUTH[1] / 0.5
    line = (0.3, -1.0, math.pi / 2)
    kinds: dict[str, tuple[list[Leg], tuple[float, float, float]]] = {
        "eights, four speeds and locks, stops (the recipe)": (RECIPE, START),
        "eights at full lock, 0.6 m/s, no stop": (
            [Leg(side, 0.6, turn_rad=2 * math.pi) for side in (1, -1)],
            START,
        ),
        "eights at 0.4 of full lock, 0.6 m/s": (eights([0.6], [0.4]), (0.0, -0.3, math.pi / 2)),
        "slalom at 0.3 of full lock, to and fro": (
            [Leg(s, v, time_s=1.0) for v in (0.5, -0.5) for s in (0.3, -0.3, 0.3, -0.3)],
            line,
        ),
        "one circle at 0.8 of full lock, with stops": (
            [Leg(0.8, 0.5, turn_rad=2 * math.pi), Leg(0.8, 0.0, time_s=0.7)],
            START,
        ),
        "to and fro on a straight line": (
            [Leg(straight, 0.5, time_s=2.5), Leg(straight, -0.5, time_s=2.5)],
            line,
        ),
    }
    print(f"| drive | {' | '.join(NAMES)} |")
    print("|---|---|---|---|---|---|")
    for kind, (legs, start) in kinds.items():
        try:
            found = calibrated(legs, TRUTH, 0, Sensors(), start)
        except BadInput as problem:
            print(f"| {kind} | refused: {problem} | | | | |")
            continue
        told = [f"{found.sigma[name]:.5f}" if name in found.sigma else "kept" for name in NAMES]
        print(f"| {kind} | {' | '.join(told)} |", flush=True)


if __name__ == "__main__":
    main()
