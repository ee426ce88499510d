"""A closed-loop drive: `Navigator.step` steers a simulated car past two waypoints, by one marker.

The navigator is not told where the car starts. It keeps every pose that explains the corners,
drives slowly across the line of sight until one is left, then drives to the waypoints.

    python examples/drive.py
"""

import jax
import jax.numpy as jnp
import numpy as np

import jaxnav as jn
from jaxnav.files import calib_dir
from jaxnav.models.geometry import T_world_vehicle_from_planar
from jaxnav.navigator import jitted_step
from jaxnav.simulation.corners import see
from jaxnav.simulation.plant import CarState, OdometryNoise, move_through, read_odometry

QCAR = calib_dir() / "qcar"
PERIOD_S = 1 / 15  # of the cameras
NOISE_PX = 0.5  # standard deviation of a corner's coordinate


def make_navigator(selector: jn.Selector | None = None) -> jn.Navigator:
    """The paper's car, marker and route."""
    rig, markers = jn.load_rig(QCAR / "rig.yaml"), jn.load_markers(QCAR / "markers.yaml")
    vehicle, route = jn.load_vehicle(QCAR / "vehicle.yaml"), jn.load_route(QCAR / "route.yaml")
    waypoints_m, radius_m = route.waypoints_m, route.waypoint_radius_m
    return jn.Navigator(rig, markers, vehicle, waypoints_m, radius_m, selector)


@jax.jit
def simulate(navigator, car, command, dt_s, key):
    """The car `dt_s` later, and what it senses there."""
    car = jax.tree.map(
        lambda leaf: leaf[-1], move_through(navigator.motion.vehicle, car, command, dt_s, 4)
    )
    T_world_vehicle = T_world_vehicle_from_planar(car.pose)
    corners_px, visible = see(navigator.rig, navigator.markers, T_world_vehicle)
    corners_px = corners_px + NOISE_PX * jax.random.normal(key, corners_px.shape)
    speed_mps, steering_rad = read_odometry(car, OdometryNoise(), jax.random.fold_in(key, 1))
    return car, jn.Observation(corners_px, visible, speed_mps, steering_rad, dt_s)


def drive(navigator: jn.Navigator, duration_s: float, seed: int = 0):
    """Yield (time_s, true pose (3,), output) of every frame until the last waypoint."""
    zero = jnp.zeros(())
    start = jnp.asarray(jn.load_route(QCAR / "route.yaml").start_pose)  # x_m, y_m, psi_rad
    state, car, command = navigator.init(), CarState(start, zero, zero), jn.Command(zero, zero)
    for frame in range(round(duration_s / PERIOD_S)):
        dt_s = jnp.asarray(PERIOD_S if frame else 0.0)
        key = jax.random.fold_in(jax.random.key(seed), frame)
        car, obs = simulate(navigator, car, command, dt_s, key)
        state, out = jitted_step(navigator, state, obs)
        command = out.command
        yield frame * PERIOD_S, np.asarray(car.pose), jax.device_get(out)
        if out.done:
            return


def main(duration_s: float = 20.0) -> dict[str, float | bool]:
    """Print every tenth frame, and return how the drive ended."""
    for frame, (time_s, true_pose, out) in enumerate(drive(make_navigator(), duration_s)):
        error_m = float(np.linalg.norm(out.pose[:2] - true_pose[:2]))
        if frame % 10 == 0 or out.done:
            x_m, y_m, psi_rad = out.pose
            command = out.command
            print(
                f"{time_s:5.2f} s  at {x_m:6.3f} m {y_m:6.3f} m {np.rad2deg(psi_rad):6.1f} deg"
                f"  off by {100 * error_m:4.1f} cm  P(flip) {out.flip_probability:7.1e}"
                f"  steers {command.steering_rad:6.3f} rad  throttle {command.throttle:.3f}"
            )
    return {"done": bool(out.done), "decided": bool(out.decided), "time_s": time_s} | {
        "error_m": error_m,
        "flip_probability": float(out.flip_probability),
    }


if __name__ == "__main__":
    main()
