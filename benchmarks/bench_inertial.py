"""What an IMU is worth to a rig in a hand that sees one marker: the table of README-inertial.md.

    python benchmarks/bench_inertial.py [--hands N]

One camera of 600 px, one upright marker of 0.172 m, corners of 1 px at 15 Hz, 8 s; an IMU at 200 Hz
with the errors of a preset.
"""

import argparse
import dataclasses
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np

from jaxnav.core.filter.choose import judge_branch
from jaxnav.core.filter.free import ConstantVelocity, FreeBody
from jaxnav.core.filter.imu import InertialMotion
from jaxnav.core.filter.kalman import nis
from jaxnav.core.models.geometry import (
    inverse_cayley,
    rotation_error_rad,
    rotation_from_matrix,
    safe_norm,
)
from jaxnav.core.models.imu import CONSUMER, TACTICAL, ImuNoise
from jaxnav.core.models.markers import MarkerMap
from jaxnav.core.navigator import Navigator
from jaxnav.files.configuration import configure
from jaxnav.sim.hand_held import HandHeld, imu_samples, observe
from jaxnav.sim.single_frames import pinhole_rig

CENTER_M = (0.0, 0.0, 1.0)
RATE_HZ, END_S, SETTLED_S = 15, 8.0, 1.0
LEAN_RAD = np.deg2rad(2.0)
FACES_X = np.array([[0.0, 0, 1], [1, 0, 0], [0, 1, 0]])


@dataclass(frozen=True)
class Situation:
    """Where a hand stands and what happens to it."""

    name: str
    stands_at_m: tuple[float, float, float]
    still_s: float = 0.0
    hidden_s: tuple[float, float] = (END_S, END_S)
    late_s: float = 0.0
    told: bool = True
    path: tuple[tuple[str, float], ...] = ()


ROLLS = (("roll_radps", 2 * np.pi), ("swing_m", 0.15), ("swing_rad", 0.1))
SITUATIONS = [
    Situation("moving, 3.6 m off", (3.5, 0.8, 1.2)),
    Situation("3.5 m off, at rest for 4 s, from above", (3.3, 0.1, 2.2), still_s=4.0),
    Situation("3.6 m off, at rest for 4 s, from the side", (3.5, 0.8, 1.2), still_s=4.0),
    Situation("1.9 m off, no marker from 4 to 7 s", (1.8, 0.7, 1.3), hidden_s=(4.0, 7.0)),
    Situation("rolls at 360 deg/s, IMU 10 ms late, told", (1.5, 0.5, 1.2), late_s=0.01, path=ROLLS),
    Situation("the same, not told", (1.5, 0.5, 1.2), late_s=0.01, told=False, path=ROLLS),
]


@dataclass(frozen=True)
class Sensor:
    """A rig's IMU, if any, and what its filter believes of gravity."""

    name: str
    motion: FreeBody
    noise: ImuNoise | None
    lean_rad: float = 0.0


def sensors() -> list[Sensor]:
    """Those that are compared."""
    # Swings of 0.25 m and 0.25 rad at 0.6 Hz: 3.6 m/s^2 and rad/s^2, alike for 0.27 s.
    as_it_moves = ConstantVelocity(acceleration_density=jnp.full(6, 2 * 3.6**2 * 0.27))
    return [
        Sensor("none", ConstantVelocity(), None),
        Sensor("none, its filter told how it moves", as_it_moves, None),
        Sensor("consumer", InertialMotion(noise=CONSUMER), CONSUMER),
        Sensor("tactical", InertialMotion(noise=TACTICAL), TACTICAL),
        Sensor("consumer, map 2 deg off", InertialMotion(noise=CONSUMER), CONSUMER, LEAN_RAD),
        Sensor("consumer, gravity not known", InertialMotion.in_any_world(CONSUMER), CONSUMER),
    ]


@jax.jit
def localise(navigator: Navigator, frames: Any) -> Any:
    """Of each frame: errors in m and rad, NEES, decided, wrong branch, seen."""

    def step(state: Any, obs: Any) -> Any:
        state, out = navigator.step(state, obs)
        truth = obs.T_world_vehicle_true
        xi = inverse_cayley(out.T_world_vehicle.inverse() @ truth)
        turn_rad = rotation_error_rad(out.T_world_vehicle, truth)
        wrong = judge_branch(out.candidates, out.selected, truth).wrong
        nees = nis(xi, out.covariance[:6, :6])
        seen = out.selected >= 0
        return state, (safe_norm(xi[:3]), turn_rad, nees, out.decided, wrong, seen)

    return jax.lax.scan(step, navigator.init(), frames)[1]


def drive(situation: Situation, sensor: Sensor, seed: int) -> dict[str, float]:
    """The scores of one hand."""
    keys = jax.random.split(jax.random.key(seed), 3)
    T = jaxlie.SE3.from_rotation_and_translation(
        rotation_from_matrix(jnp.asarray(FACES_X)), jnp.asarray(CENTER_M)
    )
    markers = MarkerMap(jaxlie.SE3(T.wxyz_xyz[None]), jnp.asarray([0.172]), (0,), ("tag36h11",))
    rig = pinhole_rig(1, 600.0, 0.0)
    path = HandHeld.draw(
        keys[0], CENTER_M, situation.stands_at_m, still_s=situation.still_s, **dict(situation.path)
    )
    stamps_ns = np.round(np.arange(0, END_S, 1 / RATE_HZ) * 1e9).astype(np.int64)
    samples, t = None, stamps_ns / 1e9
    if sensor.noise is not None:
        lean = sensor.lean_rad
        gravity = 9.81 * np.sin(lean), 0.0, -9.81 * np.cos(lean)
        samples = imu_samples(
            path, sensor.noise, keys[1], END_S, delay_s=situation.late_s, gravity_mps2=gravity
        )
        if not situation.told:
            samples = dataclasses.replace(samples, delay_s=0.0)
    begin_s, end_s = situation.hidden_s
    hidden = (t >= begin_s) & (t < end_s)
    frames = observe(path, rig, markers, samples, stamps_ns, keys[2], 1.0, hidden)
    navigator = Navigator(rig, markers, motion=sensor.motion)
    told = jax.device_get(localise(navigator, frames))
    position_m, turn_rad, nees, decided, wrong, seen = told
    judged = seen & (t > SETTLED_S)
    last = np.flatnonzero(t < end_s)[-1]
    rests = t < situation.still_s if situation.still_s else t > SETTLED_S
    return {
        "decided_s": t[decided][0] if decided.any() else np.inf,
        "decided": decided[rests & seen][-1] if (rests & seen).any() else 0.0,
        "wrong": np.sum(wrong & decided & seen) / max(np.sum(decided & seen), 1),
        "position_m": np.median(position_m[judged]),
        "turn_rad": np.median(turn_rad[judged]),
        "nees": np.mean(nees[judged]),
        "end_m": position_m[last],
        "end_rad": turn_rad[last],
    }


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--hands", type=int, default=20)
    parser.add_argument("--imu", default="", help="only what begins so")
    args = parser.parse_args()
    hands = args.hands
    configure(float64=True)
    print("| situation | IMU | decided after s, median | decided | wrong once decided |"
          " cm | deg | ANEES | at the end cm, deg |")  # fmt: skip
    print("|---|---|---|---|---|---|---|---|---|")
    for situation in SITUATIONS:
        for sensor in sensors()[: 3 if situation.path else None]:
            if not sensor.name.startswith(args.imu):
                continue
            scores = [drive(situation, sensor, seed) for seed in range(hands)]
            s = {name: np.array([score[name] for score in scores]) for name in scores[0]}
            degrees = np.rad2deg([np.median(s["turn_rad"]), np.median(s["end_rad"])])
            print(
                f"| {situation.name} | {sensor.name} | {np.median(s['decided_s']):.2f} |"
                f" {np.mean(s['decided']):.0%} | {np.mean(s['wrong']):.2%} |"
                f" {100 * np.median(s['position_m']):.1f} | {degrees[0]:.2f} |"
                f" {np.mean(s['nees']) / 6:.1f} |"
                f" {100 * np.median(s['end_m']):.0f}, {degrees[1]:.1f} |",
                flush=True,
            )


if __name__ == "__main__":
    main()
