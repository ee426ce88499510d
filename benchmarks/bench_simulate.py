"""Time closed-loop simulation: steps a second over all lanes, whole drives.

    python benchmarks/bench_simulate.py [--seeds N]
    python benchmarks/bench_simulate.py --accelerator
    pytest benchmarks/bench_simulate.py --benchmark-enable --benchmark-only

The paper's scenario at corner noise of 1 px. A step counts if its drive is still under way. CPU
time is that of all threads: on a shared machine it is more reliable than the clock.

With `--accelerator` all drives run side by side on JAX's default device.
"""

import platform
import resource
import sys
import time
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxnav.core.filter.selectors import make_selector
from jaxnav.core.navigator import Navigator
from jaxnav.files import calib_dir, load_markers, load_rig, load_vehicle
from jaxnav.files.configuration import configure
from jaxnav.sim.rollout import Rollout
from jaxnav.sim.scenarios import scenarios

SELECTORS = ("paper-cost", "lowest-reprojection", "multi-hypothesis")
FEW, MANY, ROUNDS = 100, 2048, 3
ACCELERATOR_LANES = (1024, 8192, 32768)


def rollout(selector: str, **options: Any) -> Rollout:
    """The paper's drive of a QCar."""
    qcar, scenario = calib_dir() / "qcar", scenarios()["paper"]
    vehicle, markers = load_vehicle(qcar / "vehicle.yaml"), load_markers(qcar / "markers.yaml")
    navigator = Navigator(
        load_rig(qcar / "rig.yaml"),
        markers,
        vehicle,
        waypoints_m=scenario.waypoints_m,
        selector=make_selector(selector),
    )
    return Rollout(navigator, vehicle, markers, scenario, 1.0, **options)


def _keys(count: int) -> jax.Array:
    return jax.vmap(jax.random.key)(jnp.arange(count))


def timed(drives: Rollout, seeds: int) -> tuple[float, float, int]:
    """Seconds by the clock, seconds of all threads, steps of drives under way."""
    clock, cpu = time.perf_counter(), time.process_time()
    steps = int(np.sum(drives.run(_keys(seeds)).active))
    return time.perf_counter() - clock, time.process_time() - cpu, steps


def on_accelerator() -> None:
    """Print a table of steps a second under `vmap`, by the number of lanes."""
    configure(float64=False)
    device = jax.devices()[0]
    print(f"jax {jax.__version__}, {device.device_kind}, float32, as many drives as lanes\n")
    print("| selector | lanes | steps/s | s to compile |\n|---|---|---|---|", flush=True)
    for selector in SELECTORS:
        for lanes in ACCELERATOR_LANES:
            drives = rollout(selector)
            first = timed(drives, lanes)[0]
            clock, _, steps = np.transpose([timed(drives, lanes) for _ in range(ROUNDS)])
            compiling = first - np.median(clock)
            rate = np.median(steps / clock)
            print(f"| {selector} | {lanes} | {rate:,.0f} | {compiling:.0f} |", flush=True)


def main() -> None:
    """Print the table."""
    configure(float64=False)
    jax.config.update("jax_enable_compilation_cache", False)
    many = int(sys.argv[sys.argv.index("--seeds") + 1]) if "--seeds" in sys.argv else MANY
    print(
        f"jax {jax.__version__}, {platform.processor() or platform.machine()}, float32\n\n"
        "| selector | drives | steps/s | CPU us a step | CPU s to compile |\n|---|---|---|---|---|",
        flush=True,
    )
    for selector in SELECTORS:
        drives = rollout(selector)
        for count in (FEW, many):
            cold = timed(drives, count)[1]
            clock, cpu, steps = np.transpose([timed(drives, count) for _ in range(ROUNDS)])
            print(
                f"| {selector} | {count} | {np.median(steps / clock):,.0f} | "
                f"{np.median(cpu / steps) * 1e6:.0f} | {cold - np.median(cpu):.0f} |",
                flush=True,
            )
            jax.clear_caches()
    peak_mib = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    print(f"\npeak memory of all together {peak_mib:.0f} MiB")


@pytest.mark.parametrize("selector", SELECTORS)
def test_whole_drives(benchmark: Any, selector: str) -> None:
    """A round is a thousand drives."""
    drives = rollout(selector)
    drives.run(_keys(8))
    trace = benchmark.pedantic(drives.run, (_keys(1024),), rounds=3)
    benchmark.extra_info["steps a second"] = np.sum(trace.active) / benchmark.stats["median"]


if __name__ == "__main__":
    on_accelerator() if "--accelerator" in sys.argv else main()
