"""What a copy of a marker, carried elsewhere or along, does to a car: the table of spoofing.md.

    python benchmarks/bench_spoofing.py [--seeds N]

Drives of the simulated car through the fault matrix' loop of waypoints, 10 s each. From 4 s on it
sees a copy instead of its marker.
"""

import argparse
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from jaxnav.drive.flags import Fault, Health, names
from jaxnav.files import Route, calib_dir, load_markers, load_rig, load_vehicle
from jaxnav.files.configuration import configure, step_folder
from jaxnav.recordings.drive_setup import DriveSetup
from jaxnav.vehicles.conformance.faults import WAYPOINTS_M
from jaxnav.vehicles.conformance.lockstep import BEGIN_NS, Step, drive
from jaxnav.vehicles.world import SimWorld

BEGIN_S, DRIVE_S = 4.0, 14.0
START = (2.0, -1.0, np.deg2rad(125.0))
WRONG_M = 0.3
TOLD = Fault.RELOCATED | Fault.WAYS_DISPUTED
Moves = Callable[[SimWorld, float], None]  # the world, s since the last time, 0 at the first


@dataclass(frozen=True)
class Spoof:
    """One copy. Moves of `at_m` and `scale` at once, `by_mps` all the time."""

    name: str
    at_m: tuple[float, float] = (0.0, 0.0)
    scale: float = 1.0
    by_mps: tuple[float, float] = (0.0, 0.0)
    relocate: bool = True


SPOOFS = [
    *(Spoof(f"{d:g} m to the side", (d, 0.0)) for d in (0.1, 0.2, 0.3, 0.5, 1.0)),
    Spoof("1 m to the other side", (-1.0, 0.0)),
    Spoof("1 m to the side, --no-relocate", (1.0, 0.0), relocate=False),
    *(Spoof(f"{scale:g} times as large", scale=scale) for scale in (1.1, 1.5, 2.0)),
    *(
        Spoof(f"dragged sideways at {v:g} m/s", by_mps=(v, 0.0))
        for v in (0.02, 0.05, 0.1, 0.2, 0.5)
    ),
    *(Spoof(f"dragged nearer at {v:g} m/s", by_mps=(0.0, -v)) for v in (0.05, 0.1, 0.5)),
]


def spoofed(spoof: Spoof) -> Callable[[int, SimWorld], None]:
    """What happens to the world."""
    last_ns: int | None = None

    def happens(now_ns: int, world: SimWorld) -> None:
        nonlocal last_ns
        if (now_ns - BEGIN_NS) / 1e9 < BEGIN_S:
            return
        if last_ns is None:
            world.move_markers((*spoof.at_m, 0.0), scale=spoof.scale)
        elif any(spoof.by_mps):
            x_m, y_m = (v * (now_ns - last_ns) / 1e9 for v in spoof.by_mps)
            world.move_markers((x_m, y_m, 0.0))
        last_ns = now_ns

    return happens


def line(spoof: Spoof, drives: list[list[Step]]) -> str:
    """A row of the table: the worst of several drives."""
    error_m, fast_s, slow_s, told_s, worst, seen = 0.0, 0.0, 0.0, 0.0, Health.OK, Fault(0)
    for steps in drives:
        times_s = np.array([(step.input.now_ns - BEGIN_NS) / 1e9 - BEGIN_S for step in steps])
        gaps_s = np.diff(times_s, append=times_s[-1]) * (times_s >= 0)
        outcomes = [step.outcome for step in steps]
        acts = np.array([bool(o.output.decided) and o.throttle != 0 for o in outcomes])
        errors_m = np.array([np.hypot(*(s.outcome.output.pose - s.truth[:3])[:2]) for s in steps])
        healths = np.array([outcome.health for outcome in outcomes])
        wrong = acts & (errors_m > WRONG_M)
        slow = healths >= Health.DEGRADED
        told = [time_s for time_s, o in zip(times_s, outcomes, strict=True) if o.faults & TOLD]
        error_m = max(error_m, float(np.max(errors_m * acts * (times_s >= 0))))
        fast_s = max(fast_s, float(np.sum(gaps_s * (wrong & ~slow))))
        slow_s = max(slow_s, float(np.sum(gaps_s * (wrong & slow))))
        told_s = max(told_s, min((time_s for time_s in told if time_s >= 0), default=np.inf))
        worst = max(worst, Health(int(healths[times_s >= 0].max())))
        for outcome in outcomes:
            seen |= outcome.faults & TOLD
    words = ", ".join(names(seen)).lower() or "-"
    told = f"{told_s:.1f}" if np.isfinite(told_s) else "not"
    return (
        f"| {spoof.name} | {error_m:.2f} | {slow_s:.1f} | {fast_s:.1f} | {told} | "
        f"{worst.name} | {words} |"
    )


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, default=3)
    args = parser.parse_args()
    configure(float64=False, threads=1)
    qcar = calib_dir() / "qcar"
    rig, markers = load_rig(qcar / "rig.yaml"), load_markers(qcar / "markers.yaml")
    vehicle = load_vehicle(qcar / "vehicle.yaml")
    route = Route(WAYPOINTS_M, 0.15, START)
    print(
        "| the copy | acted upon, off by m | slowly s | at speed s | told after s | worst | by |\n"
        "|---|---|---|---|---|---|---|"
    )
    for spoof in SPOOFS:
        setup = DriveSetup(rig, markers, vehicle, route, relocate=spoof.relocate)
        drives = [
            list(
                drive(
                    setup.pilot(step_folder()),
                    SimWorld(rig, markers, vehicle, START, BEGIN_NS, seed=seed),
                    DRIVE_S,
                    happens=spoofed(spoof),
                )
            )
            for seed in range(args.seeds)
        ]
        print(line(spoof, drives), flush=True)


if __name__ == "__main__":
    main()
