"""Time one step of the car against OpenCV and NumPy, its compilation and its gradient.

    python benchmarks/bench_step.py
    pytest benchmarks/bench_step.py --benchmark-enable --benchmark-only

The QCar sees the paper's marker from 3.2 m, in its front camera, at corner noise of 1 px. Steps are
run one at a time as on the car, and take turns with their peers in `step_numpy.py`.
"""

import dataclasses
import functools
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from jaxnav.files.configuration import configure, step_folder

configure(float64=False, threads=1)  # before the first array, as the commands do

import cv2  # noqa: E402
import equinox as eqx  # noqa: E402
import jax  # noqa: E402
import jax.numpy as jnp  # noqa: E402
import numpy as np  # noqa: E402
import pytest  # noqa: E402

sys.path.insert(0, str(Path(__file__).parent))

import step_numpy as peer  # noqa: E402

from jaxnav.core.control import Command  # noqa: E402
from jaxnav.core.filter.choose import PaperCost, Selector  # noqa: E402
from jaxnav.core.filter.hypotheses import MultiHypothesis  # noqa: E402
from jaxnav.core.linalg.levenberg_marquardt import KEEP_FOUND  # noqa: E402
from jaxnav.core.models.geometry import T_world_vehicle_from_planar  # noqa: E402
from jaxnav.core.navigator import Navigator, State  # noqa: E402
from jaxnav.core.pose.observation import Observation  # noqa: E402
from jaxnav.drive.compiled_step import compiled_step  # noqa: E402
from jaxnav.files import calib_dir, load_markers, load_rig, load_vehicle  # noqa: E402
from jaxnav.sim.corners import see  # noqa: E402
from jaxnav.sim.plant import CarState, move_through  # noqa: E402

STEPS, PERIOD_S, SPEED_MPS = 20, 1 / 15, 0.3
DRIVES = 5
ROUNDS = 110  # times STEPS: 2 200 steps of each
START = (0.5, -1.7, np.pi / 2)
ROLLOUT_STEPS = 100
SELECTORS: dict[str, Selector] = {"paper-cost": PaperCost(), "multi-hypothesis": MultiHypothesis()}


def navigator_with(selector: Selector, exact: bool = False) -> Navigator:
    """The paper's car on the paper's route; exact: cameras, sensors and corners without errors that
    repeat, which the peers do not know."""
    qcar = calib_dir() / "qcar"
    rig, vehicle = load_rig(qcar / "rig.yaml"), load_vehicle(qcar / "vehicle.yaml")
    if exact:
        rig = dataclasses.replace(rig, extrinsics_sigma=None)
        vehicle = dataclasses.replace(vehicle, sensor_sigma=None)
    navigator = Navigator(
        rig,
        load_markers(qcar / "markers.yaml"),
        vehicle,
        waypoints_m=[(1.30, 0.0), (0.50, 0.65)],
        selector=selector,
    )
    if not exact:
        return navigator
    unknown = lambda leaf: leaf is None  # noqa: E731
    return eqx.tree_at(lambda n: n.repeated_errors, navigator, None, is_leaf=unknown)


def observations(navigator: Navigator, count: int, seed: int) -> list[Observation]:
    """Readings along a straight line."""
    rng = np.random.default_rng(seed)
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


def as_reading(obs: Observation) -> peer.Reading:
    """The same for the peer."""
    return peer.Reading(
        np.asarray(obs.corners_px, float)[:, 0],
        np.asarray(obs.visible)[:, 0],
        *(float(value) for value in (obs.speed_mps, obs.steering_rad, obs.dt_s)),
    )


class Drive:
    """A drive by jaxnav and by its peer, from the state after the first sight."""

    def __init__(self, selector: Selector, exact: bool = True, seed: int = 0):
        self.navigator = navigator_with(selector, exact)
        self.readings = observations(self.navigator, STEPS + 1, seed)
        navigator = self.navigator
        self.step = jax.jit(lambda state, obs: navigator.step(state, obs))
        self.unstarted = navigator.init()
        self.started, _ = self.step(self.unstarted, self.readings[0])
        self.peer = peer.NumpyStep(navigator)
        self.peer_started = peer.memory(self.started)
        self.peer_readings = [as_reading(obs) for obs in self.readings]

    def ours(self, seconds: list[float]) -> None:
        state = self.started
        for obs in self.readings[1:]:
            begin = time.perf_counter()
            state, out = self.step(state, obs)
            jax.block_until_ready(out)
            seconds.append(time.perf_counter() - begin)

    def first(self, seconds: list[float]) -> None:
        """Of a car that has seen nothing yet: the whole fan."""
        for obs in self.readings[:3]:
            begin = time.perf_counter()
            _, out = self.step(self.unstarted, obs)
            jax.block_until_ready(out)
            seconds.append(time.perf_counter() - begin)

    def second(self, seconds: list[float]) -> None:
        """Right after it: the fan is still there."""
        for obs in self.readings[1:4]:
            begin = time.perf_counter()
            _, out = self.step(self.started, obs)
            jax.block_until_ready(out)
            seconds.append(time.perf_counter() - begin)

    def theirs(self, seconds: list[float]) -> None:
        state = self.peer_started
        for reading in self.peer_readings[1:]:
            begin = time.perf_counter()
            state, _ = self.peer(state, reading)
            seconds.append(time.perf_counter() - begin)


@jax.enable_x64(True)
def same_step(selector: Selector) -> tuple[float, float, float, float]:
    """Over `DRIVES` drives, how far both are apart (median, m and rad), and the share of steps in
    which both are within 1 cm and 0.01 rad, select the same candidate, and decide alike.

    In float64, as the peer. Two hypotheses of a wide belief become one in this frame or in the
    next, which rounding may tell: then the heaviest of those that are left differ.
    """
    apart, selected, decided = [], [], []
    for seed in range(DRIVES):
        drive = Drive(selector, seed=seed)
        state, memory = drive.started, drive.peer_started
        for obs, reading in zip(drive.readings[1:], drive.peer_readings[1:], strict=True):
            state, out = drive.step(state, obs)
            memory, result = drive.peer(memory, reading)
            apart.append(np.max(np.abs(np.asarray(out.pose) - result.pose)))
            selected.append(int(out.selected) == result.selected)
            decided.append(bool(out.decided) == result.decided)
    shares = np.mean([np.array(apart) < 0.01, selected, decided], axis=1)
    return float(np.median(apart)), *shares.tolist()


@pytest.mark.parametrize("name", SELECTORS)
def test_the_peer_takes_the_same_step(name: str) -> None:
    """They minimise in pixels and in normalised coordinates."""
    apart, within, selected, decided = same_step(SELECTORS[name])
    assert apart < 0.005
    assert within >= 0.8
    assert min(selected, decided) >= 0.9


@pytest.mark.parametrize("name", SELECTORS)
@pytest.mark.parametrize("who", ["ours", "first", "second", "theirs"])
def test_step(benchmark: Any, name: str, who: str) -> None:
    """A drive of `STEPS` steps, or three first or second ones."""
    cv2.setNumThreads(1)
    benchmark(getattr(Drive(SELECTORS[name]), who), [])


Parameters = tuple[jax.Array, jax.Array, jax.Array, jax.Array, jax.Array]


def rollout_loss(navigator: Navigator) -> tuple[Callable[[Parameters], jax.Array], Parameters]:
    """A closed loop of plant and step, and its parameters: Q, R twice, and both gains."""
    vehicle = load_vehicle(calib_dir() / "qcar" / "vehicle.yaml")
    where = lambda n: (  # noqa: E731
        n.motion.acceleration_density, n.motion.vision_floor, n.motion.odometry_sigma,
        n.controller.proportional_per_m, n.controller.integral_per_ms,
    )  # fmt: skip
    noise_px = jax.random.normal(jax.random.key(0), (ROLLOUT_STEPS, len(navigator.rig), 1, 4, 2))
    period_s = jnp.asarray(PERIOD_S)

    def loss(parameters: Parameters) -> jax.Array:
        tuned = eqx.tree_at(where, navigator, parameters)

        @functools.partial(jax.checkpoint, policy=KEEP_FOUND, prevent_cse=False)
        def frame(carry: tuple[CarState, Command, State], noise: jax.Array) -> Any:
            car, command, state = carry
            car = jax.tree.map(
                lambda leaf: leaf[-1], move_through(vehicle, car, command, period_s, 4)
            )
            corners_px, visible = see(
                tuned.rig, tuned.markers, T_world_vehicle_from_planar(car.pose)
            )
            obs = Observation(
                corners_px=jnp.where(visible[..., None, None], corners_px + noise, 0),
                visible=visible,
                speed_mps=car.speed_mps,
                steering_rad=car.steering_rad,
                dt_s=period_s,
            )
            state, out = tuned.step(state, obs)
            return (car, out.command, state), jnp.sum((out.pose[:2] - car.pose[:2]) ** 2)

        zero = jnp.zeros(())
        start = CarState(jnp.asarray(START, float), zero, zero)
        _, errors = jax.lax.scan(frame, (start, Command(zero, zero), tuned.init()), noise_px)
        return jnp.mean(errors)

    return loss, where(navigator)


@pytest.mark.parametrize("name", SELECTORS)
@pytest.mark.parametrize("what", ["forward", "gradient"])
def test_rollout(benchmark: Any, name: str, what: str) -> None:
    """A rollout of `ROLLOUT_STEPS` steps, and its gradient."""
    loss, parameters = rollout_loss(navigator_with(SELECTORS[name]))
    function = jax.jit(loss if what == "forward" else jax.grad(loss))
    benchmark(lambda: jax.block_until_ready(function(parameters)))


def print_steps() -> None:
    """Median and 99 % of the step, ours and theirs."""
    cv2.setNumThreads(1)
    drives = {name: Drive(selector) for name, selector in SELECTORS.items()}
    drives["default"] = Drive(MultiHypothesis(), exact=False)
    rows = [(name, who) for name in drives for who in ("ours", "theirs", "first", "second")]
    for left_out in ("paper-cost", "first"), ("paper-cost", "second"), ("default", "theirs"):
        rows.remove(left_out)
    seconds: dict[tuple[str, str], list[float]] = {row: [] for row in rows}
    for _ in range(ROUNDS):
        for name, who in rows:
            getattr(drives[name], who)(seconds[name, who])
    labels = {
        "ours": "{}", "theirs": "{}, cv2 + NumPy",
        "first": "{}, first sight: the fan starts", "second": "{}, the step after: the whole fan",
    }  # fmt: skip
    print("| one step | median us | 99 % us | calls |\n|---|---|---|---|")
    for (name, who), times in seconds.items():
        median, high = np.quantile(times, [0.5, 0.99]) * 1e6
        print(f"| {labels[who].format(name)} | {median:.0f} | {high:.0f} | {len(times)} |")
    print("\n| the same step? | poses apart, median (m, rad) | within 0.01 | same candidate "
          "| same decided |\n|---|---|---|---|---|")  # fmt: skip
    for name, selector in SELECTORS.items():
        apart, *shares = same_step(selector)
        print(f"| {name} | {apart:.4f} | {' | '.join(f'{share:.1%}' for share in shares)} |")


def print_compilation() -> None:
    """From a navigator to its first step, in fresh processes: `jax.jit` without and with what a
    process before it has left in JAX's cache; `compiled_step` with what one has left in its own."""
    print("\n| trace + compile | trace s | lower s | compile s | sum s |\n|---|---|---|---|---|")
    for name in SELECTORS:
        with tempfile.TemporaryDirectory() as cache:

            def seconds(how: str, name: str = name, cache: str = cache) -> list[float]:
                run = subprocess.run(
                    [sys.executable, __file__, how, name],
                    env=os.environ | {"JAX_COMPILATION_CACHE_DIR": cache},
                    capture_output=True,
                    text=True,
                    check=True,
                )
                return [float(part) for part in run.stdout.split()]

            for kind in ("cold", "JAX's cache"):
                parts = seconds("--compile")
                cells = " | ".join(f"{part:.2f}" for part in (*parts, sum(parts)))
                print(f"| {name}, {kind} | {cells} |")
            seconds("--load")
            print(f"| {name}, `compiled_step` | | | | {seconds('--load')[0]:.2f} |")


def load_once(name: str) -> None:
    """Seconds until the first step is done, by way of `compiled_step`."""
    navigator = navigator_with(SELECTORS[name])
    state, obs = navigator.init(), observations(navigator, 1, seed=0)[0]
    begin = time.perf_counter()
    jax.block_until_ready(compiled_step(navigator, step_folder())(state, obs))
    print(time.perf_counter() - begin)


def compile_once(name: str) -> None:
    """Seconds to trace, lower and compile one step."""
    navigator = navigator_with(SELECTORS[name])
    state, obs = navigator.init(), observations(navigator, 1, seed=0)[0]
    stamps = [time.perf_counter()]
    traced = jax.jit(lambda state, obs: navigator.step(state, obs)).trace(state, obs)
    stamps.append(time.perf_counter())
    lowered = traced.lower()
    stamps.append(time.perf_counter())
    lowered.compile()
    stamps.append(time.perf_counter())
    print(*np.diff(stamps))


def print_gradients() -> None:
    """Gradient over forward pass, medians of interleaved runs."""
    print(f"\n| {ROLLOUT_STEPS} steps | forward ms | gradient ms | ratio | forward, gradient MiB |")
    print("|---|---|---|---|---|")
    for name, selector in SELECTORS.items():
        loss, parameters = rollout_loss(navigator_with(selector))
        both = [jax.jit(f).lower(parameters).compile() for f in (loss, jax.value_and_grad(loss))]
        value, gradients = both[1](parameters)
        assert all(jnp.all(jnp.isfinite(g)) for g in gradients)
        assert np.isclose(value, both[0](parameters), rtol=0.05)
        seconds: list[list[float]] = [[], []]
        for _ in range(20):
            for function, times in zip(both, seconds, strict=True):
                begin = time.perf_counter()
                jax.block_until_ready(function(parameters))
                times.append(time.perf_counter() - begin)
        forward, gradient = (np.median(times) * 1e3 for times in seconds)
        ratio = np.median(np.array(seconds[1]) / np.array(seconds[0]))
        memory = [f.memory_analysis().temp_size_in_bytes / 2**20 for f in both]
        print(f"| {name} | {forward:.1f} | {gradient:.1f} | {ratio:.2f} "
              f"| {memory[0]:.2f}, {memory[1]:.2f} |")  # fmt: skip


def main() -> None:
    """Print the tables."""
    if sys.argv[1:2] == ["--compile"]:
        compile_once(sys.argv[2])
        return
    if sys.argv[1:2] == ["--load"]:
        load_once(sys.argv[2])
        return
    print(f"jax {jax.__version__}, OpenCV {cv2.__version__}, NumPy {np.__version__}, "
          f"{jnp.zeros(1).dtype}, {jax.default_backend()}, {os.cpu_count()} cores\n")  # fmt: skip
    print_steps()
    print_compilation()
    print_gradients()


if __name__ == "__main__":
    main()
