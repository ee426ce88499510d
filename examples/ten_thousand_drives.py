"""Many drives at once: one drive is a function of a key, and `jax.vmap` makes many of it.

    python examples/ten_thousand_drives.py                     # 10000 drives: some minutes
    python examples/ten_thousand_drives.py 500 paper-cost      # fewer, with another selector

A wrong start is a first pose to act upon whose heading is off by more than 20 degrees: the mirror
image of the true one. `jaxnav.simulation.rollout.Rollout.run` runs so many drives faster, since a
drive that has ended makes room for the next one.
"""

import dataclasses
import sys

import jax
import jax.numpy as jnp
import numpy as np
from drive import QCAR, make_navigator  # examples/drive.py

import jaxnav as jn
from jaxnav.belief.selectors import make_selector
from jaxnav.models.geometry import wrap_angle
from jaxnav.simulation.rollout import Rollout
from jaxnav.simulation.scenarios import scenarios
from jaxnav.simulation.statistics import wilson_interval

WRONG_RAD = np.deg2rad(20.0)
AT_ONCE = 500  # drives


def main(
    count: int = 10_000,
    selector: str = "multi-hypothesis",
    duration_s: float = 20.0,
    noise_px: float = 1.0,
) -> dict[str, np.ndarray]:
    """Run `count` drives of the paper's experiment.

    Returns:
        success, wrong_start: (count,) bool.
    """
    scenario = dataclasses.replace(scenarios()["paper"], duration_s=duration_s)
    navigator = make_navigator(make_selector(selector))
    vehicle = jn.load_vehicle(QCAR / "vehicle.yaml")
    rollout = Rollout(navigator, vehicle, navigator.markers, scenario, noise_px)

    def drive(key):
        """One drive: whether it passed all waypoints, and whether it began wrong."""

        def frame(carry, _):
            world, acted, wrong = carry
            world, trace = rollout.frame(world, navigator.step)
            turn_rad = wrap_angle(trace.pose[2] - trace.true_pose[2])
            first = trace.decided & ~acted
            return (world, acted | first, wrong | (first & (jnp.abs(turn_rad) > WRONG_RAD))), None

        begin = rollout.first(key), jnp.asarray(False), jnp.asarray(False)
        (world, _, wrong), _ = jax.lax.scan(frame, begin, length=scenario.frames)
        return world.on_floor & (world.passed == len(scenario.waypoints_m)), wrong

    at_once = min(count, AT_ONCE)
    keys = jax.random.split(jax.random.key(0), -(-count // at_once) * at_once)
    drives = jax.jit(jax.vmap(drive))
    ended = [drives(keys[i : i + at_once]) for i in range(0, len(keys), at_once)]
    success, wrong_start = (np.concatenate(one)[:count] for one in zip(*ended, strict=True))
    for name, these in {"success": success, "wrong start": wrong_start}.items():
        low, high = wilson_interval(np.array(these.mean()), np.array(count))
        rate = f"{100 * these.mean():.2f} %, between {100 * low:.2f} and {100 * high:.2f} %"
        print(f"{name:12} {these.sum()} of {count} drives: {rate} (95 % interval)")
    return {"success": success, "wrong_start": wrong_start}


if __name__ == "__main__":
    main(int((sys.argv[1:] or ["10000"])[0]), (sys.argv[2:] or ["multi-hypothesis"])[0])
