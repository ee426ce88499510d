"""Many drives at once: one drive is a function of a key, and `jax.vmap` makes many of it.

    python examples/ten_thousand_drives.py                     # 10000 drives: some minutes
    python examples/ten_thousand_drives.py 500 paper-cost      # fewer, with another selector

A wrong start is a first pose to act upon whose heading is off by more than 20 degrees: the mirror
image of the true one. `jaxnav.sim.rollout.Rollout.run` runs so many drives faster, since a
drive that has ended makes room for the next one.
"""

import dataclasses
import sys

import jax
import jax.numpy as jnp
import numpy as np
from drive import make_navigator  # examples/drive.py

from jaxnav.core.filter.selectors import make_selector
from jaxnav.core.models.geometry import wrap_angle
from jaxnav.sim.rollout import Rollout
from jaxnav.sim.scenarios import scenarios
from jaxnav.sim.statistics import wilson_interval

WRONG_RAD, AT_ONCE = np.deg2rad(20.0), 500


def main(
    count: int = 10_000, selector: str = "multi-hypothesis", duration_s: float = 20.0
) -> dict[str, np.ndarray]:
    """Run drives of the paper's experiment with 1 px of noise; (count,) bool of each outcome."""
    scenario = dataclasses.replace(scenarios()["paper"], duration_s=duration_s)
    navigator = make_navigator(make_selector(selector))
    rollout = Rollout(navigator, navigator.motion.vehicle, navigator.markers, scenario, 1.0)

    def drive(key):
        """One drive: whether it passed all waypoints, and whether it began wrong."""

        def frame(world, _):
            world, trace, _ = rollout.frame(world, navigator.step)
            return world, (trace.decided, wrap_angle(trace.pose[2] - trace.true_pose[2]))

        first = rollout.first(key)
        world, (decided, turn_rad) = jax.lax.scan(frame, first, length=scenario.frames)
        began = jnp.argmax(decided)  # the first frame that is decided, if any
        success = world.on_floor & (world.passed == len(scenario.waypoints_m))
        return success, decided[began] & (jnp.abs(turn_rad[began]) > WRONG_RAD)

    drives = jax.jit(jax.vmap(drive))
    keys = jax.random.split(jax.random.key(0), count)
    ended = [drives(keys[i : i + AT_ONCE]) for i in range(0, count, AT_ONCE)]
    success, wrong_start = (np.concatenate(one) for one in zip(*ended, strict=True))
    for name, these in {"success": success, "wrong start": wrong_start}.items():
        low, high = wilson_interval(np.array(these.mean()), np.array(count))
        print(f"{name:12} {these.sum()} of {count} drives, 95 % interval {low:.2%} to {high:.2%}")
    return {"success": success, "wrong_start": wrong_start}


if __name__ == "__main__":
    main(int((sys.argv[1:] or ["10000"])[0]), (sys.argv[2:] or ["multi-hypothesis"])[0])
