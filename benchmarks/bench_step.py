"""One step of the car: the bank of hypotheses against a single one, and what the fan costs.

    python benchmarks/bench_step.py

The QCar sees the paper's marker from 3.2 m at corner noise of 1 px. All steps are compiled once,
run one at a time as on the car, and take turns; medians over the rounds.
"""

import time
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np

from jaxnav.ambiguity import LowestReprojection, Mahalanobis, PaperCost, Selector
from jaxnav.files import calib_dir, load_markers, load_rig, load_vehicle
from jaxnav.geometry import T_world_vehicle_from_planar
from jaxnav.hypotheses import MultiHypothesis
from jaxnav.navigator import Navigator, State
from jaxnav.observation import Observation
from jaxnav.simulation.corners import see

ROUNDS, STEPS, PERIOD_S, SPEED_MPS = 30, 20, 1 / 15, 0.3
START = (0.5, -1.7, np.pi / 2 - 0.9)


def observations(navigator: Navigator, count: int) -> list[Observation]:
    """Readings along a straight line."""
    rng = np.random.default_rng(0)
    seen = jax.jit(lambda pose: see(navigator.rig, navigator.markers,
                                    T_world_vehicle_from_planar(pose)))  # fmt: skip
    readings = []
    for frame in range(count):
        travelled_m = SPEED_MPS * PERIOD_S * frame
        along = travelled_m * np.array([np.cos(START[2]), np.sin(START[2]), 0])
        corners_px, visible = seen(jnp.asarray(START + along))
        noise_px = jnp.asarray(rng.normal(size=corners_px.shape), corners_px.dtype)
        readings.append(
            Observation(
                corners_px=jnp.where(visible[..., None, None], corners_px + noise_px, 0),
                visible=visible,
                speed_mps=jnp.asarray(SPEED_MPS),
                steering_rad=jnp.asarray(0.0),
                dt_s=jnp.asarray(PERIOD_S),
            )
        )
    return readings


def task(selector: Selector, first: bool) -> Callable[[], object]:
    """`STEPS` steps of a drive; or as many first ones, of a car that has seen nothing yet."""
    qcar = calib_dir() / "qcar"
    navigator = Navigator(
        load_rig(qcar / "rig.yaml"),
        load_markers(qcar / "markers.yaml"),
        load_vehicle(qcar / "vehicle.yaml"),
        waypoints_m=[(1.30, 0.0), (0.50, 0.65)],
        selector=selector,
    )
    readings = observations(navigator, STEPS)
    step: Callable[..., tuple[State, object]] = jax.jit(navigator.step)
    unstarted = navigator.init()
    started, _ = step(unstarted, readings[0])

    def run() -> None:
        state = started
        for obs in readings:
            state, out = step(unstarted if first else state, obs)
            jax.block_until_ready(out)

    return run


def main() -> None:
    """Print the table."""
    tasks = {
        "lowest-reprojection": task(LowestReprojection(), False),
        "paper-cost": task(PaperCost(), False),
        "mahalanobis": task(Mahalanobis(), False),
        "multi-hypothesis": task(MultiHypothesis(), False),
        "multi-hypothesis, first step: the fan": task(MultiHypothesis(), True),
    }
    for run in tasks.values():
        run()
    times: dict[str, list[float]] = {name: [] for name in tasks}
    for _ in range(ROUNDS):
        for name, run in tasks.items():
            started = time.perf_counter()
            run()
            times[name].append((time.perf_counter() - started) / STEPS * 1e6)
    single = np.array(times["lowest-reprojection"])
    print(f"{jnp.zeros(1).dtype}, {jax.default_backend()}\n")
    print("| one step of the car | us | times lowest-reprojection |\n|---|---|---|")
    for name, microseconds in times.items():
        ratio = np.median(np.array(microseconds) / single)
        print(f"| {name} | {np.median(microseconds):.0f} | {ratio:.2f} |")


if __name__ == "__main__":
    main()
