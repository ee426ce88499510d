"""Run many closed-loop drives at once, at corner level: one scan, batched over the seeds.

The navigator's own `step` is in the loop; plant, odometer and corners are those of `drive.py`
without its images. The car of a finished drive stands still, and its frames are not counted.
"""

import dataclasses
import os
from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, Key, PyTree, UInt32

from jaxnav.core.control import TwistCommand
from jaxnav.core.filter.kalman import nis
from jaxnav.core.models.geometry import T_world_vehicle_from_planar, safe_norm, wrap_angle
from jaxnav.core.models.markers import MarkerMap
from jaxnav.core.models.vehicle import TwistBase, Vehicle
from jaxnav.core.navigator import Navigator, Step
from jaxnav.core.pose.observation import Observation
from jaxnav.files.executables import kept
from jaxnav.sim.corners import drifted, see
from jaxnav.sim.drive import PASSED_M
from jaxnav.sim.gyro import read_gyro, switched_on
from jaxnav.sim.plant import (
    BaseState,
    CarState,
    at_rest,
    move_through,
    odometry,
    standing,
)
from jaxnav.sim.queue import Slots, program_sizes, run_drives
from jaxnav.sim.scenarios import Scenario
from jaxnav.sim.traces import DriveTraces
from jaxnav.sim.world import DriveState, Spread, nominal, with_bank

_SUBSTEPS = 4  # for each of the two parts of a frame period


class Trace(eqx.Module):
    """The record of every frame, leading axes (seeds, frames)."""

    true_pose: Float[Array, "*S 3"]
    pose: Float[Array, "*S 3"]
    nees: Float[Array, "*S"]  # of (x, y, psi), 3 dof
    located: Bool[Array, "*S"]
    decided: Bool[Array, "*S"]
    flip_probability: Float[Array, "*S"]
    lm_steps: Int[Array, "*S"]  # the most that any candidate took
    active: Bool[Array, "*S"]  # the drive had not ended before this frame
    on_floor: Bool[Array, "*S"]
    passed: Int[Array, "*S"]  # number of waypoints, in order, that the true car has come near to
    done: Bool[Array, "*S"]  # in the navigator's belief


class Keep(eqx.Module):
    """A record of every frame beside its `Trace`; this one keeps nothing."""

    def __call__(self, before: DriveState, obs: Observation, after: DriveState) -> PyTree:
        """The record of a frame, by the worlds before and after it and what was observed."""
        return None


class Rollout(eqx.Module):
    """A simulation of drives of one navigator in one scenario, many side by side (`run_drives`)."""

    navigator: Navigator
    vehicle: Vehicle | TwistBase
    markers: MarkerMap
    scenario: Scenario
    corner_noise_px: Float[Array, ""] = eqx.field(converter=jnp.asarray)
    spread: Spread | None = None  # None: all cars are nominal
    chunk_frames: int = eqx.field(static=True, default=8)

    def run(
        self, keys: Key[Array, " S"], progress: Callable[[int], object] = lambda ended: None
    ) -> Trace:
        """Run every drive: a trace, leading axes (S, frames), as long as the longest drive.

        Args:
            keys: one for each drive; a key's drive does not depend on the others.
            progress: called with the number of drives that have ended since the last call.
        """
        return self.run_keeping(keys, Keep(), progress)[0]

    def run_keeping(
        self,
        keys: Key[Array, " S"],
        keep: Keep,
        progress: Callable[[int], object] = lambda ended: None,
        like: int | None = None,
    ) -> tuple[Trace, PyTree]:
        """`run`, and `keep`'s record of every frame; after a drive's end its last is repeated.

        Args:
            like: with the programs for so many drives, and so with their bits; by default those of
                `keys`.
        """
        # All that the spread decides is in a drive's start.
        under_way = dataclasses.replace(self, spread=None)
        traces = run_drives(
            keys,
            lambda keys: _start(self, jax.random.key_data(keys)),
            lambda worlds, slots: _advance(under_way, keep, worlds, slots),
            program_sizes(self.navigator, like or len(keys)),
            DriveTraces(len(keys), self.chunk_frames),
            os.cpu_count() or 1,
            progress,
        )
        (trace, further), own = jax.tree.map(
            lambda leaf: leaf[:, : self.scenario.frames], traces.stack()
        )
        return eqx.tree_at(lambda t: t.active, trace, trace.active & own), further

    def start(self, keys: Key[Array, " S"]) -> DriveState:
        """The worlds of drives before their first frames, leading axis (S,)."""
        return _start(self, jax.random.key_data(keys))

    def first(self, key: Key[Array, ""]) -> DriveState:
        """The world of a drive before its first frame."""
        scenario = self.scenario
        key, start_key, rig_key = jax.random.split(key, 3)
        spread = jnp.asarray(scenario.start_spread)
        start = jnp.asarray(scenario.start_pose) + spread * jax.random.uniform(
            start_key, (3,), spread.dtype, -1, 1
        )
        corners = (len(self.navigator.rig), len(self.markers.ids), 4, 2)
        drift = jax.random.normal(jax.random.fold_in(rig_key, 1), corners, start.dtype)
        told_key = jax.random.fold_in(rig_key, 3)
        truth = nominal(self.vehicle, scenario, told_key, start.dtype)
        if self.spread is not None:
            truth_key = jax.random.fold_in(rig_key, 2)
            truth = self.spread.draw(truth_key, truth, scenario.frame_period_s)
        gyro = None
        if truth.vehicle.gyro is not None:
            gyro_key = jax.random.fold_in(rig_key, 4)
            gyro = switched_on(
                truth.vehicle.gyro,
                scenario.gyro_late_s,
                scenario.frame_period_s,
                gyro_key,
                start.dtype,
            )
        stands = standing(truth.vehicle, start.dtype)
        return DriveState(
            key=jax.random.key_data(key),
            rig=scenario.true_rig(self.navigator.rig, rig_key),
            truth=truth,
            drift=drift,
            start_pose=start,
            car=at_rest(truth.vehicle, start),
            acting=stands,
            command=stands,
            gyro=gyro,
            state=self.navigator.init(),
            frame=jnp.asarray(0),
            seen=jnp.asarray(0),
            passed=jnp.asarray(0),
            ended=jnp.asarray(False),
            on_floor=jnp.asarray(True),
        )

    def chunk(
        self, world: DriveState, keep: Keep, slots: Slots
    ) -> tuple[DriveState, tuple[Trace, PyTree], Bool[Array, ""]]:
        """Advance a drive by `chunk_frames`: the record of each, and whether slots were lacking."""
        step = slots.limit(self.navigator).step

        def frame(
            carry: tuple[DriveState, Array], _: None
        ) -> tuple[tuple[DriveState, Array], tuple[Trace, PyTree]]:
            world, lacks = carry
            after, trace, obs = self.frame(world, step)
            lacks |= slots.lack(after.seen, world.bank, after.bank) & ~world.ended
            return (strong(after), lacks), (trace, keep(world, obs, after))

        start = with_bank(world, slots.cut(world.bank)), jnp.asarray(False)
        (after, lacks), records = jax.lax.scan(frame, start, length=self.chunk_frames)
        return with_bank(after, slots.restored(after.bank, world.bank)), records, lacks

    def frame(self, world: DriveState, step: Step) -> tuple[DriveState, Trace, Observation]:
        """Move for a frame period, the last command acting after its latency; then observe."""
        scenario = self.scenario
        dtype = world.car.pose.dtype
        period_s = jnp.asarray(scenario.frame_period_s, dtype)
        moves = world.frame > 0
        stamp_s = world.frame * period_s
        car = jax.tree.map(
            lambda new, old: jnp.where(moves & ~world.ended, new, old),
            self._moved(world, period_s),
            world.car,
        )
        turned_rad = car.pose[2] - world.car.pose[2]
        car = scenario.displaced(car, stamp_s, period_s)
        key = jax.random.wrap_key_data(world.key)
        key_corners, key_odometry = jax.random.split(jax.random.fold_in(key, world.frame))

        # Late corners lie where they were a part of a frame period earlier.
        part = world.truth.sensor_errors[-1] / scenario.frame_period_s
        earlier = scenario.displaced(world.car, stamp_s, period_s)
        seen_from = car.pose + part * (earlier.pose - car.pose)
        corners_px, visible = see(world.rig, self.markers, T_world_vehicle_from_planar(seen_from))
        noise_px = self.corner_noise_px * jax.random.normal(key_corners, corners_px.shape, dtype)
        drift = drifted(
            world.drift, scenario.corner_correlation, jax.random.fold_in(key_corners, 1)
        )
        noise_px = noise_px + drift * scenario.corner_drift_px
        visible = visible & ~scenario.hidden(stamp_s)
        corners_px = jnp.where(visible[..., None, None], corners_px + noise_px, 0)
        dt_s = jnp.where(moves, period_s, 0)
        wheels = odometry(
            self.vehicle,
            world.truth.sensed(car),
            scenario.odometry,
            key_odometry,
            world.truth.odometer_scale,
            stamp_s,
        )
        gyro, gyro_radps, has = world.gyro, None, world.truth.vehicle.gyro
        if gyro is not None and has is not None:
            key_gyro = jax.random.fold_in(key_odometry, 1)
            gyro, gyro_radps = read_gyro(has, gyro, turned_rad, dt_s, key_gyro)
        truth = T_world_vehicle_from_planar(car.pose)
        obs = Observation(
            corners_px=corners_px,
            visible=visible,
            dt_s=dt_s,
            gyro_radps=gyro_radps,
            **wheels,
            **scenario.other_sensors(car, truth, key_odometry),
        )
        state, out = step(world.state, obs)

        waypoints_m = jnp.asarray(scenario.waypoints_m, dtype).reshape(-1, 2)
        count = waypoints_m.shape[0]
        target_m = waypoints_m[jnp.minimum(world.passed, count - 1)]
        near = safe_norm(car.pose[:2] - target_m) <= PASSED_M
        passed = jnp.where(world.ended, world.passed, jnp.minimum(world.passed + near, count))
        x_min, x_max, y_min, y_max = scenario.floor_m
        x_m, y_m = car.pose[:2]
        inside = (x_min <= x_m) & (x_m <= x_max) & (y_min <= y_m) & (y_m <= y_max)
        on_floor = world.on_floor & inside
        error = (out.pose - car.pose).at[2].set(wrap_angle(out.pose[2] - car.pose[2]))
        trace = Trace(
            true_pose=car.pose,
            pose=out.pose,
            nees=nis(error, out.covariance[:3, :3]),
            located=out.located,
            decided=out.decided,
            flip_probability=out.flip_probability,
            lm_steps=jnp.max(jnp.where(out.candidates.valid, out.candidates.steps, 0)),
            active=~world.ended,
            on_floor=on_floor,
            passed=passed,
            done=out.done,
        )
        command = standing(self.vehicle, x_m.dtype)
        if isinstance(command, TwistCommand):
            turn = jnp.full_like(command.turn_radps, scenario.turns_radps)
            command = dataclasses.replace(command, turn_radps=turn)
        if out.command is not None and scenario.drives:
            command = out.command
        frame = world.frame + 1
        ended = world.ended | ~on_floor | (frame >= scenario.frames)
        if scenario.drives:
            ended = ended | out.done
        after = dataclasses.replace(
            world,
            drift=drift,
            car=car,
            acting=world.command,
            command=command,
            gyro=gyro,
            state=state,
            frame=frame,
            seen=jnp.sum(visible),
            passed=passed,
            ended=ended,
            on_floor=on_floor,
        )
        return after, trace, obs

    def _moved(self, world: DriveState, period_s: Array) -> CarState | BaseState:
        """The car one period later: a command acts `latency_s` after the frame it came from."""
        car, latency_s = world.car, world.truth.latency_s
        for command, dt_s in ((world.acting, latency_s), (world.command, period_s - latency_s)):
            states = move_through(world.truth.vehicle, car, command, dt_s, _SUBSTEPS)
            car = jax.tree.map(lambda leaf: leaf[-1], states)
        return car


def strong(world: DriveState) -> DriveState:
    """The world with strong types, as a step returns it, or a step would be compiled twice."""
    typed: DriveState = jax.tree.map(
        lambda leaf: jax.lax.convert_element_type(leaf, leaf.dtype), world
    )
    return typed


@kept
def _start(rollout: Rollout, keys: UInt32[Array, "drives 2"]) -> DriveState:
    return strong(jax.vmap(lambda key: rollout.first(jax.random.wrap_key_data(key)))(keys))


@kept
def _advance(
    rollout: Rollout, keep: Keep, worlds: DriveState, slots: Slots
) -> tuple[DriveState, tuple[Trace, PyTree], Bool[Array, " drives"]]:
    return jax.vmap(lambda world: rollout.chunk(world, keep, slots))(worlds)
