"""Many closed-loop drives at once, at corner level: one scan, vmapped over the seeds.

The navigator's own `step` is in the loop; plant, odometer and corners are those of `drive.py`
without its images. Finished drives stand still and are not counted any further.
"""

from collections import deque
from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, Key

from jaxnav.bicycle import Vehicle
from jaxnav.control import Command
from jaxnav.geometry import T_world_vehicle_from_planar, safe_norm, wrap_angle
from jaxnav.kalman import nis
from jaxnav.markers import MarkerMap
from jaxnav.navigator import Navigator, State
from jaxnav.observation import Observation
from jaxnav.rig import CameraRig
from jaxnav.simulation.corners import see
from jaxnav.simulation.drive import PASSED_M
from jaxnav.simulation.plant import CarState, move_through, read_odometry
from jaxnav.simulation.scenarios import Scenario
from jaxnav.simulation.single_frames import directions
from jaxnav.trees import where

_SUBSTEPS = 4  # of either part of a frame period


class Trace(eqx.Module):
    """What is kept of every frame, leading axes (seeds, frames)."""

    true_pose: Float[Array, "*S 3"]
    pose: Float[Array, "*S 3"]
    nees: Float[Array, "*S"]  # of (x, y, psi), 3 dof
    located: Bool[Array, "*S"]
    decided: Bool[Array, "*S"]
    flip_probability: Float[Array, "*S"]
    lm_steps: Int[Array, "*S"]  # of the slower candidate
    active: Bool[Array, "*S"]  # the drive had not ended before this frame
    on_floor: Bool[Array, "*S"]
    passed: Int[Array, "*S"]  # waypoints the true car has come near to, in order
    done: Bool[Array, "*S"]  # the navigator believes so


class _World(eqx.Module):
    """What one seed drew, and where its drive stands."""

    key: Array
    rig: CameraRig  # the true one
    bias: Float[Array, "C M 4 2"]  # directions in the image
    car: CarState
    acting: Command  # until the latency of the next one is over
    command: Command
    state: State
    frame: Int[Array, ""]  # the next one
    passed: Int[Array, ""]
    ended: Bool[Array, ""]
    on_floor: Bool[Array, ""]


class Rollout(eqx.Module):
    """Drives of one navigator in one scenario, compiled once for a batch of lanes.

    A lane whose drive has ended takes the next seed, so that long drives keep nobody waiting.
    """

    navigator: Navigator
    vehicle: Vehicle
    markers: MarkerMap
    scenario: Scenario = eqx.field(static=True)
    corner_noise_px: Float[Array, ""] = eqx.field(converter=jnp.asarray)
    # Of every corner of every camera, in a direction of its own, the same in all frames of a drive.
    corner_bias_px: Float[Array, ""] = eqx.field(converter=jnp.asarray, default=0.0)
    start_pose: Float[Array, " 3"] | None = None  # in place of the scenario's
    lanes: int = eqx.field(static=True, default=128)
    chunk_frames: int = eqx.field(static=True, default=30)

    def run(
        self, keys: Key[Array, " S"], progress: Callable[[int], object] = lambda ended: None
    ) -> Trace:
        """Every drive, leading axes (S, frames): as many frames as the longest one has.

        Args:
            keys: a drive for each; a key's drive does not depend on the others.
            progress: called with the number of drives that have ended since the last call.
        """
        lanes = min(self.lanes, len(keys))
        owner, waiting = np.arange(lanes), deque(range(lanes, len(keys)))
        chunks: list[list[Trace]] = [[] for _ in keys]
        worlds = self._start(keys[:lanes])
        while np.any(owner >= 0):
            worlds, trace = self._advance(worlds)
            trace, over = jax.device_get((trace, worlds.ended))
            for lane in np.flatnonzero(owner >= 0):
                chunks[owner[lane]].append(jax.tree.map(lambda leaf, lane=lane: leaf[lane], trace))
            over = over & (owner >= 0)
            owner[over] = [waiting.popleft() if waiting else -1 for _ in range(over.sum())]
            starts = over & (owner >= 0)
            if np.any(starts):
                fresh = self._start(keys[np.maximum(owner, 0)])
                worlds = where(jnp.asarray(starts), fresh, worlds)
            progress(int(over.sum()))
        return _side_by_side(chunks)

    @eqx.filter_jit
    def _start(self, keys: Key[Array, " lanes"]) -> _World:
        return jax.vmap(self._first)(keys)

    @eqx.filter_jit
    def _advance(self, worlds: _World) -> tuple[_World, Trace]:
        """Some frames of every lane."""
        advanced: tuple[_World, Trace] = jax.vmap(
            lambda world: jax.lax.scan(lambda w, _: self._frame(w), world, length=self.chunk_frames)
        )(worlds)
        return advanced

    def _first(self, key: Array) -> _World:
        scenario = self.scenario
        key, start_key, rig_key = jax.random.split(key, 3)
        spread = jnp.asarray(scenario.start_spread)
        start_pose = scenario.start_pose if self.start_pose is None else self.start_pose
        start = jnp.asarray(start_pose) + spread * jax.random.uniform(
            start_key, (3,), spread.dtype, -1, 1
        )
        zero = jnp.zeros_like(start[0])
        corners = (len(self.navigator.rig), len(self.markers.ids), 4)
        turns = jax.random.uniform(jax.random.fold_in(rig_key, 1), corners, start.dtype)
        return _World(
            key=key,
            rig=scenario.true_rig(self.navigator.rig, rig_key),
            bias=directions(turns),
            car=CarState(start, zero, zero),
            acting=Command(zero, zero),
            command=Command(zero, zero),
            state=self.navigator.init(),
            frame=jnp.asarray(0),
            passed=jnp.asarray(0),
            ended=jnp.asarray(False),
            on_floor=jnp.asarray(True),
        )

    def _frame(self, world: _World) -> tuple[_World, Trace]:
        """Move for a frame period, the command of the last frame after its latency; then look."""
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
        car = scenario.displaced(car, stamp_s, period_s)
        key_corners, key_odometry = jax.random.split(jax.random.fold_in(world.key, world.frame))

        # A smear shifts the corners to where they were a little earlier.
        smear = scenario.corner_lag_s / scenario.frame_period_s
        seen_from = car.pose + smear * (world.car.pose - car.pose)
        corners_px, visible = see(world.rig, self.markers, T_world_vehicle_from_planar(seen_from))
        noise_px = self.corner_noise_px * jax.random.normal(key_corners, corners_px.shape, dtype)
        noise_px = noise_px + self.corner_bias_px * world.bias
        visible = visible & ~scenario.hidden(stamp_s)
        corners_px = jnp.where(visible[..., None, None], corners_px + noise_px, 0)
        speed_mps, steering_rad = read_odometry(car, scenario.odometry, key_odometry)
        truth = T_world_vehicle_from_planar(car.pose)
        obs = Observation(
            corners_px=corners_px,
            visible=visible,
            speed_mps=speed_mps,
            steering_rad=steering_rad,
            dt_s=jnp.where(moves, period_s, 0),
            **scenario.other_sensors(car, truth, key_odometry),
        )
        state, out = self.navigator.step(world.state, obs)

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
        command = Command(*(jnp.zeros_like(x_m),) * 2)
        if out.command is not None and scenario.drives:
            command = out.command
        frame = world.frame + 1
        ended = world.ended | ~on_floor | (frame >= scenario.frames)
        if scenario.drives:
            ended = ended | out.done
        return _World(
            world.key,
            world.rig,
            world.bias,
            car,
            world.command,
            command,
            state,
            frame,
            passed,
            ended,
            on_floor,
        ), trace

    def _moved(self, world: _World, period_s: Array) -> CarState:
        """The car one period later: a command acts `latency_s` after the frame it stems from."""
        latency_s = jnp.asarray(self.scenario.latency_s, period_s.dtype)
        car = world.car
        for command, dt_s in ((world.acting, latency_s), (world.command, period_s - latency_s)):
            states = move_through(self.vehicle, car, command, dt_s, _SUBSTEPS)
            car = jax.tree.map(lambda leaf: leaf[-1], states)
        return car


def _side_by_side(chunks: list[list[Trace]]) -> Trace:
    """Drives of unequal length as one array: what is over stays as it was, and is not active."""
    drives: list[Trace] = [
        jax.tree.map(lambda *leaves: np.concatenate(leaves), *parts) for parts in chunks
    ]
    frames = max(len(drive.active) for drive in drives)

    def stacked(*leaves: np.ndarray) -> np.ndarray:
        rest = [[(0, frames - len(leaf))] + [(0, 0)] * (leaf.ndim - 1) for leaf in leaves]
        return np.stack([np.pad(a, p, mode="edge") for a, p in zip(leaves, rest, strict=True)])

    active = [np.pad(drive.active, (0, frames - len(drive.active))) for drive in drives]
    trace: Trace = jax.tree.map(stacked, *drives)
    return eqx.tree_at(lambda t: t.active, trace, np.stack(active))
