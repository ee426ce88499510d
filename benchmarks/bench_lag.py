"""What a lag costs a step: `python benchmarks/bench_lag.py`.

A car on its route and a free body pass the paper's marker at 30 Hz, with the QCar's four cameras,
exact and as its file says; `Navigator(lag_s=2.0)` and the filter alone take turns, each step alone.
"""

import dataclasses
import time

import numpy as np

from jaxnav.files.configuration import configure

configure(float64=False, threads=1)  # before the first array, as the commands do

import jax  # noqa: E402
import jax.numpy as jnp  # noqa: E402

from jaxnav.core.filter.free import ConstantVelocity  # noqa: E402
from jaxnav.core.models.geometry import T_world_vehicle_from_planar  # noqa: E402
from jaxnav.core.models.markers import MarkerMap  # noqa: E402
from jaxnav.core.models.rig import CameraRig  # noqa: E402
from jaxnav.core.navigator import Navigator, State  # noqa: E402
from jaxnav.core.pose.observation import Observation  # noqa: E402
from jaxnav.files import calib_dir, load_markers, load_rig, load_vehicle  # noqa: E402
from jaxnav.sim.corners import see  # noqa: E402

PERIOD_S, LAG_S, SIGMA_PX = 1 / 30, 2.0, 0.3
FILLS, TIMED, ROUNDS = 100, 50, 20  # steps that fill the window, steps of a round, rounds
SPEED_MPS, HEADING_RAD = 0.25, 1.4


def observations(rig: CameraRig, markers: MarkerMap) -> list[Observation]:
    """Readings along a straight line."""
    rng, seen = np.random.default_rng(4), jax.jit(see)
    readings = []
    for frame in range(FILLS + TIMED):
        way_m = SPEED_MPS * PERIOD_S * frame
        pose = [way_m * np.cos(HEADING_RAD) - 0.3, way_m * np.sin(HEADING_RAD) - 1.5, HEADING_RAD]
        T = T_world_vehicle_from_planar(jnp.asarray(pose, float))
        corners_px, visible = seen(rig, markers, T)
        noise_px = SIGMA_PX * rng.standard_normal(corners_px.shape)
        readings.append(
            Observation(
                jnp.asarray(corners_px + noise_px, float),
                visible,
                speed_mps=jnp.asarray(SPEED_MPS, float),
                steering_rad=jnp.asarray(0.0, float),
                dt_s=jnp.asarray(PERIOD_S, float),
            )
        )
    return readings


def times_us(navigators: dict[str, Navigator], readings: list[Observation]) -> dict[str, float]:
    """The median time of a step of each, in turns."""
    ready: dict[str, tuple[object, State]] = {}
    for name, navigator in navigators.items():
        step, state = jax.jit(navigator.step), navigator.init()
        for obs in readings[:FILLS]:
            state, output = step(state, obs)
        jax.block_until_ready(output)
        ready[name] = step, state
    taken: dict[str, list[float]] = {name: [] for name in navigators}
    for _ in range(ROUNDS):
        for name, (step, state) in ready.items():
            for obs in readings[FILLS:]:
                began_s = time.perf_counter()
                state, output = step(state, obs)  # type: ignore[operator]
                jax.block_until_ready(output)
                taken[name].append(time.perf_counter() - began_s)
    return {name: 1e6 * float(np.median(all_s)) for name, all_s in taken.items()}


def main() -> None:
    """Print the table."""
    qcar = calib_dir() / "qcar"
    markers, told = load_markers(qcar / "markers.yaml"), load_rig(qcar / "rig.yaml")
    vehicle = load_vehicle(qcar / "vehicle.yaml")
    print("| | filter, us | lag of 2 s, us |\n|---|---|---|")
    for cameras, rig in (
        ("exact cameras", dataclasses.replace(told, extrinsics_sigma=None)),
        ("cameras as told", told),
    ):
        readings = observations(rig, markers)
        for body, of in (
            ("car", {"vehicle": vehicle, "waypoints_m": [(1.3, 0.0), (0.5, 0.65)]}),
            ("free body", {"motion": ConstantVelocity()}),
        ):
            navigators = {
                name: Navigator(rig, markers, corner_sigma_px=SIGMA_PX, lag_s=lag_s, **of)
                for name, lag_s in (("filter", 0.0), ("lag", LAG_S))
            }
            took = times_us(navigators, readings)
            print(f"| {body}, {cameras} | {took['filter']:.0f} | {took['lag']:.0f} |", flush=True)


if __name__ == "__main__":
    main()
