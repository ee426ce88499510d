"""Many closed-loop drives at once, at corner level: one scan, vmapped over the seeds.

The navigator's own `step` is in the loop; plant, odometer and corners are those of `drive.py`
without its images. Finished drives stand still and are not counted any further.
"""

import os
import threading
from collections import deque
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from contextlib import nullcontext
from typing import Any, cast

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, Key

from jaxnav.bicycle import Vehicle
from jaxnav.control import Command
from jaxnav.geometry import T_world_vehicle_from_planar, safe_norm, wrap_angle
from jaxnav.kalman import nis
from jaxnav.lanes import COMPILER_OPTIONS, lanes_first, lanes_last, over_lanes
from jaxnav.markers import MarkerMap
from jaxnav.navigator import Navigator, State, Step
from jaxnav.observation import Observation
from jaxnav.rig import CameraRig
from jaxnav.simulation.corners import see
from jaxnav.simulation.drive import PASSED_M
from jaxnav.simulation.plant import CarState, move_through, read_odometry
from jaxnav.simulation.scenarios import Scenario
from jaxnav.simulation.single_frames import directions
from jaxnav.trees import where

_jit = cast(Any, eqx.filter_jit)  # whose types know of no compiler options
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

    A lane whose drive has ended takes the next seed, so that long drives keep nobody waiting. Many
    drives run through `over_lanes`, a thread for each core or device: ten times as fast as `vmap`,
    which compiles ten times as fast and so is for a few.
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
    chunk_frames: int = eqx.field(static=True, default=15)
    many: int = eqx.field(static=True, default=2048)  # drives for which `over_lanes` pays
    many_lanes: int = eqx.field(static=True, default=1024)  # a thread
    threads: int = eqx.field(static=True, default=max(1, os.cpu_count() or 1))

    def run(
        self, keys: Key[Array, " S"], progress: Callable[[int], object] = lambda ended: None
    ) -> Trace:
        """Every drive, leading axes (S, frames): as many frames as the longest one has.

        Args:
            keys: a drive for each; a key's drive does not depend on the others.
            progress: called with the number of drives that have ended since the last call.
        """
        if len(keys) < self.many:
            lanes, threads, advance = min(self.lanes, len(keys)), 1, self._advance
        else:
            lanes, threads, advance = self.many_lanes, self.threads, self._advance_many
        devices = jax.local_devices()
        if len(devices) > 1:
            threads = len(devices)  # every device has one, and runs what another would run
        drives = _Drives(len(keys), self.chunk_frames)
        waiting, lock = deque(range(len(keys))), threading.Lock()
        compiling = threading.Lock()  # one thread does it for all

        over_all = threading.Event()

        def work() -> None:
            owner = np.full(lanes, -1)
            worlds = self._start(keys[np.zeros(lanes, int)])
            over = np.ones(lanes, bool)
            turn: Any = compiling
            while True:
                with lock:
                    owner[over] = [waiting.popleft() if waiting else -1 for _ in range(over.sum())]
                if over_all.is_set() or not np.any(owner >= 0):
                    return
                starts = over & (owner >= 0)
                if np.any(starts):
                    fresh = self._start(keys[np.maximum(owner, 0)])
                    worlds = where(jnp.asarray(starts), fresh, worlds)
                with turn:
                    worlds, trace = advance(worlds)
                turn = nullcontext()
                trace, ended = jax.device_get((trace, worlds.ended))
                over = ended & (owner >= 0)
                with lock:
                    drives.take(owner, trace)
                    progress(int(over.sum()))

        threads = max(1, min(threads, -(-len(keys) // lanes)))
        if threads == 1:
            work()
            return drives.side_by_side()
        float64 = jnp.zeros(()).dtype == jnp.float64  # which a thread would not know

        def work_alike(number: int) -> None:
            with jax.enable_x64(float64), jax.default_device(devices[number % len(devices)]):
                work()

        with ThreadPoolExecutor(threads) as pool:
            working = [pool.submit(work_alike, number) for number in range(threads)]
            try:
                for one in working:
                    one.result()
            finally:
                over_all.set()  # an interruption or a failure ends all of them
        return drives.side_by_side()

    @eqx.filter_jit
    def _start(self, keys: Key[Array, " lanes"]) -> _World:
        worlds = jax.vmap(self._first)(keys)
        # Types as `_advance` returns them, or it would be compiled twice.
        return jax.tree.map(lambda leaf: jax.lax.convert_element_type(leaf, leaf.dtype), worlds)

    @eqx.filter_jit
    def _advance(self, worlds: _World) -> tuple[_World, Trace]:
        """Some frames of every lane."""
        step = self.navigator.step
        advanced: tuple[_World, Trace] = jax.vmap(
            lambda world: jax.lax.scan(
                lambda w, _: self._frame(w, step), world, length=self.chunk_frames
            )
        )(worlds)
        return advanced

    @_jit(compiler_options=COMPILER_OPTIONS)
    def _advance_many(self, worlds: _World) -> tuple[_World, Trace]:
        """The same for many lanes, each with no more work than it has."""
        step = self.navigator.step_by_regime
        frame = over_lanes(lambda world: self._frame(world, step))
        worlds, trace = jax.lax.scan(
            lambda w, _: frame(w), lanes_last(worlds), length=self.chunk_frames
        )
        return lanes_first(worlds), lanes_first(trace)

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

    def _frame(self, world: _World, step: Step) -> tuple[_World, Trace]:
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


class _Drives:
    """What was kept of every drive, chunk by chunk as it comes in."""

    def __init__(self, count: int, chunk_frames: int):
        self.chunks = np.zeros(count, int)  # of each drive
        self.chunk_frames = chunk_frames
        self.pieces: list[tuple[np.ndarray, np.ndarray, Trace]] = []

    def take(self, owner: np.ndarray, trace: Trace) -> None:
        """One chunk of the drives that own a lane; -1 owns none."""
        taken = np.flatnonzero(owner >= 0)
        drive = owner[taken]
        piece: Trace = jax.tree.map(lambda leaf: leaf[taken], trace)
        self.pieces.append((drive, self.chunks[drive], piece))
        self.chunks[drive] += 1

    def side_by_side(self) -> Trace:
        """Unequal lengths as one array: what is over stays as it was, and is not active."""
        count, most, length = len(self.chunks), self.chunks.max(), self.chunk_frames

        def joined(*leaves: np.ndarray) -> np.ndarray:
            whole = np.zeros((count, most, *leaves[0].shape[1:]), leaves[0].dtype)
            for (drive, number, _), leaf in zip(self.pieces, leaves, strict=True):
                whole[drive, number] = leaf
            return whole.reshape(count, most * length, *leaves[0].shape[2:])

        trace: Trace = jax.tree.map(joined, *(piece for _, _, piece in self.pieces))
        frames, own = np.arange(most * length)[None], (self.chunks * length)[:, None]
        last, active = np.minimum(frames, own - 1), trace.active & (frames < own)
        trace = jax.tree.map(lambda leaf: leaf[np.arange(count)[:, None], last], trace)
        return eqx.tree_at(lambda t: t.active, trace, active)
