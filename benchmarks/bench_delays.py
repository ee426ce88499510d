"""How soon and how surely a camera that is late without saying so is found: many simulated drives.

    python benchmarks/bench_delays.py --drives 200

The car of the fault matrix follows its route by the paper's control law and its true pose, so that
all drives are made at once; corners at 30 Hz, 30 ms after they were seen, odometry at 50 Hz with
its noise of the other simulations. See README-delays.md.
"""

import argparse
import dataclasses
import math
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import jaxlie
import numpy as np

from jaxnav.core.models.geometry import T_world_vehicle_from_planar
from jaxnav.drive.camera_delays import CameraDelays
from jaxnav.drive.history import Sighting
from jaxnav.files import calib_dir, load_markers, load_rig, load_vehicle
from jaxnav.sim.corners import see
from jaxnav.vehicles.conformance.faults import WAYPOINTS_M

STEP_S, FRAME_S, READING_S = 0.005, 1 / 30, 0.02
START_SPREAD = np.array([0.1, 0.1, math.radians(10.0)])


@dataclasses.dataclass(frozen=True)
class Kind:
    """What is wrong with a drive."""

    name: str
    late_s: float = 0.0  # of all cameras
    corner_px: float = 1.0
    odometer_scale: float = 1.0
    steering_gain: float = 1.0
    turned_rad: float = 0.0  # of every camera, about an axis of its own
    cameras_late: tuple[int, ...] = (0, 1, 2, 3)


KINDS = (
    Kind("clean, 0.3 px", corner_px=0.3),
    Kind("clean, 1 px"),
    Kind("slip 10 %", odometer_scale=1.1),
    Kind("blur 20 ms", late_s=0.02),
    Kind("cameras off by 1 degree", turned_rad=math.radians(1.0)),
    Kind("steering gain 10 % off", steering_gain=1.1),
    Kind("50 ms early", late_s=-0.05),
    Kind("50 ms late, 0.3 px", late_s=0.05, corner_px=0.3),
    Kind("50 ms late", late_s=0.05),
    Kind("50 ms late, slip 10 %", late_s=0.05, odometer_scale=1.1),
    Kind("50 ms late, front alone", late_s=0.05, cameras_late=(0,)),
    Kind("100 ms late", late_s=0.1),
    Kind("150 ms late", late_s=0.15),
)


def tracks(vehicle: Any, drives: int, duration_s: float, seed: int) -> np.ndarray:
    """(T, N, 5): x_m y_m psi_rad speed_mps steering_rad every `STEP_S`."""
    rng = np.random.default_rng(seed)
    start = np.array([2.0, -1.0, math.radians(125.0)])
    x, y, psi = (start + START_SPREAD * rng.uniform(-1, 1, (drives, 3))).T.copy()
    speed, steering, integral = np.zeros((3, drives))
    aim = np.zeros(drives, int)
    wheelbase_m = float(vehicle.wheelbase_m)
    limit_rad, rate_radps = (
        float(v) for v in (vehicle.steering_limit_rad, vehicle.steering_rate_limit_radps)
    )
    waypoints = np.array(WAYPOINTS_M)
    lag = 1 - math.exp(-STEP_S / float(vehicle.speed_time_constant_s))
    rows = []
    for _ in range(int(duration_s / STEP_S)):
        rows.append(np.stack([x, y, psi, speed, steering], axis=1))
        away = waypoints[np.minimum(aim, len(waypoints) - 1)] - np.stack([x, y], axis=1)
        distance = np.linalg.norm(away, axis=1)
        reached = distance < 0.15
        aim, integral = aim + reached, np.where(reached, 0, integral + distance * STEP_S)
        alpha = np.angle(np.exp(1j * (np.arctan2(away[:, 1], away[:, 0]) - psi)))
        wanted = np.arctan2(2 * wheelbase_m * np.sin(alpha), distance)
        wanted = np.clip(np.where(np.abs(alpha) > math.pi / 2, np.sign(alpha), wanted),
                         -limit_rad, limit_rad)  # fmt: skip
        throttle = np.clip(0.03 * distance + 0.005 * integral, 0, float(vehicle.throttle_limit))
        turn = np.clip(wanted - steering, -rate_radps * STEP_S, rate_radps * STEP_S)
        gain = lag * (throttle * float(vehicle.speed_per_throttle_mps) - speed)
        middle_rad, middle_m = steering + turn / 2, STEP_S * (speed + gain / 2)
        beta = np.arctan(np.tan(middle_rad) / 2)
        half_rad = middle_m * np.cos(beta) * np.tan(middle_rad) / wheelbase_m / 2
        course_rad = psi + beta + half_rad
        x, y = x + middle_m * np.cos(course_rad), y + middle_m * np.sin(course_rad)
        psi, steering, speed = psi + 2 * half_rad, steering + turn, speed + gain
    return np.stack(rows)


@jax.jit
def _views(rig: Any, markers: Any, poses: jax.Array) -> tuple[jax.Array, jax.Array]:
    return jax.vmap(lambda pose: see(rig, markers, T_world_vehicle_from_planar(pose)))(poses)


def driven(kind: Kind, track: np.ndarray, delays: CameraDelays, world: Any, seed: int) -> float:
    """One drive (T, 5) as a pilot would tell of it; when some camera was first said to be late, s,
    inf: never."""
    rig, markers, _ = world
    rng, told_s = np.random.default_rng(seed), math.inf
    times_s = np.arange(len(track)) * STEP_S

    def at(when_s: np.ndarray) -> np.ndarray:
        return np.stack([np.interp(when_s, times_s, column) for column in track.T], axis=1)

    frames_s = np.arange(0.3, times_s[-1] - 0.1, FRAME_S)
    axes = rng.standard_normal((len(rig), 3))
    axes *= kind.turned_rad / np.linalg.norm(axes, axis=1, keepdims=True)
    seen_by = turned(rig, axes) if kind.turned_rad else rig
    corners_px, visible = _views(seen_by, markers, jnp.asarray(at(frames_s)[:, :3], float))
    late = _views(seen_by, markers, jnp.asarray(at(frames_s - kind.late_s)[:, :3], float))
    is_late = np.isin(np.arange(len(rig)), kind.cameras_late)[None, :, None]
    visible = np.where(is_late, late[1], visible)
    corners_px = np.where(is_late[..., None, None], late[0], corners_px)
    corners_px = corners_px + rng.normal(0, kind.corner_px, corners_px.shape)
    sigma_px = np.full(corners_px.shape[1:-1], kind.corner_px)
    readings_s = np.arange(0, times_s[-1], READING_S)
    read = at(readings_s)[:, 3:] * [kind.odometer_scale, 1 / kind.steering_gain]
    read += rng.normal(0, [0.01, 0.005], read.shape)
    poses = at(readings_s)[:, :3] + rng.normal(0, 0.02, 3)
    frame = 0
    for when_s, reading, pose in zip(readings_s, read, poses, strict=True):
        while frame < len(frames_s) and frames_s[frame] + 0.03 <= when_s:
            told = {"corners_px": corners_px[frame], "visible": visible[frame]}
            seen = Sighting(**told, sigma_px=sigma_px)
            if visible[frame].any():
                delays.add_corners(_ns(frames_s[frame]), seen)
            frame += 1
        delays.add_reading(_ns(when_s), *reading.tolist())
        if when_s > 0.8:
            delays.add_pose(_ns(when_s), pose)
        while delays.due:
            delays.solve()
            told_s = min(told_s, when_s) if delays.late else told_s
    return told_s


def _ns(when_s: float) -> int:
    return 10**9 + int(when_s * 1e9)


def turned(rig: Any, axes_rad: np.ndarray) -> Any:
    """A rig whose cameras are turned in their places."""
    turns = jaxlie.SE3.from_rotation(jaxlie.SO3.exp(jnp.asarray(axes_rad, float)))
    return eqx.tree_at(lambda r: r.Ts_camera_vehicle, rig, turns @ rig.Ts_camera_vehicle)


def main() -> None:
    """Print a table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--drives", type=int, default=200)
    parser.add_argument("--duration-s", type=float, default=12.0)
    parser.add_argument("--only", default="")
    args = parser.parse_args()
    qcar = calib_dir() / "qcar"
    world = load_rig(qcar / "rig.yaml"), load_markers(qcar / "markers.yaml"), load_vehicle(
        qcar / "vehicle.yaml"
    )  # fmt: skip
    paths = tracks(world[2], args.drives, args.duration_s, seed=0)
    print("| drive | told late | after s, median / 95 % | known cameras a drive "
          "| off ms, median / 95 % | spread in sigma |")  # fmt: skip
    print("|---|---|---|---|---|---|")
    for kind in KINDS:
        if args.only and args.only not in kind.name:
            continue
        told, off, sure = [], [], []
        for n in range(args.drives):
            delays = CameraDelays(*world)
            told.append(driven(kind, paths[:, n], delays, world, n))
            for camera, one in enumerate(delays.delays):
                late_s = kind.late_s if camera in kind.cameras_late else 0.0
                if one.known:
                    off.append(abs(one.delay_s - late_s))
                    sure.append(off[-1] / one.sigma_s)
        late_at = np.array(told)[np.isfinite(told)]
        after = _quantiles(late_at, ".1f") if len(late_at) else "-"
        print(
            f"| {kind.name} | {len(late_at) / args.drives:.1%} | {after} | "
            f"{len(off) / args.drives:.2f} | {_quantiles(np.array(off) * 1e3, '.1f')} | "
            f"{np.sqrt(np.mean(np.square(sure))):.2f} |",
            flush=True,
        )


def _quantiles(values: np.ndarray, form: str) -> str:
    return " / ".join(f"{np.quantile(values, share):{form}}" for share in (0.5, 0.95))


if __name__ == "__main__":
    main()
