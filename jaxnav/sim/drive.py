"""Run one closed-loop drive: one navigator steers the car, others get the same observations.

The loop runs on the host, so the cameras may be anything: rendered images with a detector, or
corners with noise. A command acts `latency_s` after the stamp of the frame it was computed from.
"""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from jaxnav.core.control import Command
from jaxnav.core.filter.choose import Branch, judge_branch
from jaxnav.core.models.geometry import T_world_vehicle_from_planar
from jaxnav.core.models.vehicle import Vehicle
from jaxnav.core.navigator import Navigator, Output, State, Step, jitted_step
from jaxnav.core.pose.observation import Observation
from jaxnav.errors import BadInput
from jaxnav.sim.plant import CarState, OdometryNoise, move_through, read_odometry

PASSED_M = 0.30  # a waypoint counts as passed when the true car came this close
_SUBSTEPS = 8  # between two events: some 5 ms each

# times_s -> T_world_vehicle, wxyz_xyz
PoseAt = Callable[[Float[np.ndarray, " N"]], Float[np.ndarray, "N 7"]]
# The true motion around a stamp, the stamp, and what the driver believes (None at first) ->
# corners, visible, sigma or None.
Look = Callable[
    [PoseAt, float, Output | None],
    tuple[
        Float[np.ndarray, "C M 4 2"],
        Bool[np.ndarray, "C M"],
        Float[np.ndarray, "C M 4"] | None,
    ],
]


@dataclass(frozen=True)
class DriveSettings:
    """Settings of a drive: start, timing and odometry."""

    start_pose: tuple[float, float, float]  # x_m, y_m, psi_rad; the navigator is not told
    frame_period_s: float = 1 / 15  # the paper's cluster captures and detects at 15 Hz
    latency_s: float = 0.03
    duration_s: float = 30.0
    floor_m: tuple[float, float, float, float] = (-2.5, 2.5, -2.5, 2.5)  # x_min x_max y_min y_max
    odometry: OdometryNoise = field(default_factory=OdometryNoise)


@dataclass(frozen=True)
class DriveFrame:
    """One step of a drive: the truth, and every method's output for the same observation."""

    stamp_s: float
    true_pose: Float[np.ndarray, " 3"]
    observation: Observation
    outputs: Mapping[str, Output]
    branches: Mapping[str, Branch]


class Methods:
    """A set of navigators under comparison, each compiled once; all get the same observations.

    The first one drives.
    """

    def __init__(
        self,
        navigators: Mapping[str, Navigator],
        compiled: Callable[[Navigator], Step] = lambda navigator: partial(jitted_step, navigator),
    ):
        self._navigators = dict(navigators)
        self._steps = {name: compiled(navigator) for name, navigator in navigators.items()}
        self.reset()

    def reset(self) -> None:
        """Reset every navigator to its initial state, for another drive."""
        self._states: dict[str, State] = {n: nav.init() for n, nav in self._navigators.items()}

    @property
    def driver(self) -> str:
        """The name of the navigator that drives."""
        return next(iter(self._navigators))

    def step(
        self, observation: Observation, true_pose: Float[Array, " 3"]
    ) -> tuple[dict[str, Output], dict[str, Branch]]:
        """All outputs, on the host, and each choice judged against the truth."""
        outputs, branches = {}, {}
        for name, step in self._steps.items():
            self._states[name], outputs[name] = step(self._states[name], observation)
            branches[name] = _judged(outputs[name], true_pose)
        return jax.device_get((outputs, branches))


@jax.jit
def _judged(output: Output, true_pose: jax.Array) -> Branch:
    truth = T_world_vehicle_from_planar(true_pose)
    return judge_branch(output.candidates, output.selected, truth)


def drive(
    methods: Methods,
    vehicle: Vehicle,
    look: Look,
    settings: DriveSettings,
    seed: int,
) -> Iterator[DriveFrame]:
    """Run a drive frame by frame until it is done, off the floor or out of time.

    Args:
        methods: the navigators, of which the first drives; they are reset.
        vehicle: the true car.
        look: the cameras.
        settings: start, timing and odometry.
        seed: seed of the odometry noise.
    """
    if not 0 <= settings.latency_s < settings.frame_period_s:
        raise BadInput(
            "latency_s", f"must be at least 0 and below the frame period, got {settings.latency_s}"
        )
    methods.reset()
    motion = _Motion(vehicle, settings.start_pose)
    key = jax.random.key(seed)
    frames = int(np.ceil(settings.duration_s / settings.frame_period_s))
    believed: Output | None = None
    for index in range(frames):
        stamp_s = index * settings.frame_period_s
        motion.run_until(stamp_s + settings.latency_s)
        true = motion.state_at(stamp_s)
        corners_px, visible, sigma_px = look(motion.poses_at, stamp_s, believed)
        key, odometry_key = jax.random.split(key)
        speed_mps, steering_rad = read_odometry(
            true, settings.odometry, odometry_key, stamp_s=stamp_s
        )
        observation = Observation(
            corners_px=jnp.asarray(corners_px, float),
            visible=jnp.asarray(visible),
            speed_mps=speed_mps,
            steering_rad=steering_rad,
            dt_s=jnp.asarray(settings.frame_period_s if index else 0.0, float),
            corner_sigma_px=None if sigma_px is None else jnp.asarray(sigma_px, float),
        )
        outputs, branches = methods.step(observation, true.pose)
        believed = outputs[methods.driver]
        assert believed.command is not None
        yield DriveFrame(stamp_s, np.asarray(true.pose), observation, outputs, branches)
        x_min, x_max, y_min, y_max = settings.floor_m
        x_m, y_m, _ = np.asarray(true.pose)
        if bool(believed.done) or not (x_min <= x_m <= x_max and y_min <= y_m <= y_max):
            return
        motion.command = believed.command


def waypoints_passed(
    true_poses: Float[np.ndarray, "N 3"], waypoints_m: Float[np.ndarray, "W 2"]
) -> int:
    """The number of waypoints, taken in order, that the true car came within 0.30 m of."""
    passed = 0
    for pose in true_poses:
        while (
            passed < len(waypoints_m) and np.linalg.norm(pose[:2] - waypoints_m[passed]) <= PASSED_M
        ):
            passed += 1
    return passed


_advance = jax.jit(move_through, static_argnums=4)


class _Motion:
    """The true trajectory so far, sampled densely enough for linear interpolation."""

    def __init__(self, vehicle: Vehicle, start_pose: tuple[float, float, float]):
        zero = jnp.zeros(())
        self.command = Command(zero, zero)
        self._state = CarState(jnp.asarray(start_pose, float), zero, zero)
        self._vehicle = vehicle
        # At rest before the drive begins.
        self._times_s = [-1e3, 0.0]
        self._rows = [self._row(self._state)] * 2

    @staticmethod
    def _row(state: CarState) -> np.ndarray:
        return np.append(np.asarray(state.pose), [state.speed_mps, state.steering_rad])

    def run_until(self, time_s: float) -> None:
        """Move the car under the present command up to a time."""
        begin_s = self._times_s[-1]
        dt_s = time_s - begin_s
        if dt_s <= 0:
            return
        states = _advance(
            self._vehicle, self._state, self.command, jnp.asarray(dt_s, float), _SUBSTEPS
        )
        self._state = jax.tree.map(lambda leaf: leaf[-1], states)
        rows = np.column_stack([states.pose, states.speed_mps, states.steering_rad])
        self._times_s += list(begin_s + dt_s * np.arange(1, len(rows) + 1) / len(rows))
        self._rows += list(rows)

    def _interpolated(self, times_s: np.ndarray) -> np.ndarray:
        recent = np.asarray(self._times_s[-64:]), np.asarray(self._rows[-64:])
        return np.column_stack([np.interp(times_s, recent[0], column) for column in recent[1].T])

    def state_at(self, time_s: float) -> CarState:
        """The true state at one instant already simulated."""
        row = self._interpolated(np.asarray([time_s]))[0]
        return CarState(
            jnp.asarray(row[:3], float), jnp.asarray(row[3], float), jnp.asarray(row[4], float)
        )

    def poses_at(self, times_s: np.ndarray) -> np.ndarray:
        """T_world_vehicle (N, 7), wxyz_xyz, at instants already simulated."""
        x_m, y_m, psi_rad = self._interpolated(np.asarray(times_s))[:, :3].T
        zero = np.zeros_like(x_m)
        return np.column_stack(
            [np.cos(psi_rad / 2), zero, zero, np.sin(psi_rad / 2), x_m, y_m, zero]
        )
