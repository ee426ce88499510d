"""Rollouts with a spy in place of the navigator, which tells what it was given."""

import dataclasses
from collections.abc import Callable
from types import SimpleNamespace

import equinox as eqx
import jax
import jax.numpy as jnp

from jaxnav.core.control import Command
from jaxnav.core.filter.choose import LowestReprojection
from jaxnav.core.models.geometry import planar_from_T_world_vehicle
from jaxnav.core.navigator import Navigator
from jaxnav.sim.plant import OdometryNoise
from jaxnav.sim.rollout import Rollout, Trace
from jaxnav.sim.scenarios import Scenario, scenarios
from tests import worlds

RIG, MARKERS, CAR = worlds.qcar_rig(), worlds.paper_markers(), worlds.qcar()
QUIET = OdometryNoise(speed_sigma_mps=0.0, steering_sigma_rad=0.0)
SEEDS = jnp.asarray([3, 5, 8])
keys = jax.vmap(jax.random.key)


class Spy(Navigator):
    """Sends one command, and tells through the trace what it was given.

    `told(obs)` becomes `flip_probability`; `located` says whether anything was in view. The number
    of frames so far is in `belief.restarts`.
    """

    throttle: float = eqx.field(static=True)
    steering_rad: float = eqx.field(static=True)
    told: Callable = eqx.field(static=True)

    def __init__(self, throttle=0.0, steering_rad=0.0, told=lambda obs: obs.speed_mps, rig=RIG):
        super().__init__(rig, MARKERS, selector=LowestReprojection())
        self.throttle, self.steering_rad, self.told = throttle, steering_rad, told

    def step(self, state, obs):
        one = SimpleNamespace(valid=jnp.ones(1, bool), steps=jnp.ones(1, int))
        state = eqx.tree_at(lambda s: s.belief.restarts, state, state.belief.restarts + 1)
        return state, SimpleNamespace(
            candidates=one,
            pose=planar_from_T_world_vehicle(obs.T_world_vehicle_true),
            covariance=jnp.eye(6),
            located=jnp.any(obs.visible),
            decided=jnp.asarray(True),
            flip_probability=self.told(obs),
            done=jnp.asarray(False),
            command=Command(
                jnp.asarray(self.steering_rad, float), jnp.asarray(self.throttle, float)
            ),
        )


def run(navigator, scenario: Scenario, noise_px=0.0, seeds=SEEDS, chunk_frames=15) -> Trace:
    """The whole rollout, leading axes (seeds, frames)."""
    rollout = Rollout(navigator, CAR, MARKERS, scenario, noise_px, chunk_frames=chunk_frames)
    return rollout.run(keys(seeds))


def short(name: str, **changes) -> Scenario:
    """A scenario from where it starts, without the spread of the start and odometry noise."""
    changes = {"duration_s": 1.0, "start_spread": (0.0, 0.0, 0.0), "odometry": QUIET} | changes
    return dataclasses.replace(scenarios()[name], **changes)
