"""A closed-loop drive: `Navigator.step` steers a simulated car past two waypoints, by one marker.

Run it with `python examples/drive.py`.
"""

import jax
import jax.numpy as jnp

import jaxnav as jn
from jaxnav.core.models.geometry import T_world_vehicle_from_planar
from jaxnav.core.navigator import jitted_step
from jaxnav.files import calib_dir
from jaxnav.sim.corners import see
from jaxnav.sim.plant import CarState, OdometryNoise, move, read_odometry

QCAR = calib_dir() / "qcar"
PERIOD_S, NOISE_PX = 1 / 15, 0.5  # of the cameras; standard deviation of a corner's coordinate


def make_navigator(selector: jn.Selector | None = None) -> jn.Navigator:
    """The paper's car, marker and route."""
    rig, markers = jn.load_rig(QCAR / "rig.yaml"), jn.load_markers(QCAR / "markers.yaml")
    vehicle, route = jn.load_vehicle(QCAR / "vehicle.yaml"), jn.load_route(QCAR / "route.yaml")
    return jn.Navigator(rig, markers, vehicle, route.waypoints_m, route.waypoint_radius_m, selector)


@jax.jit
def simulate(nav, car, command, dt_s, key):
    """The car `dt_s` later, and what it senses there."""
    car = move(nav.motion.vehicle, car, command, dt_s)
    corners_px, visible = see(nav.rig, nav.markers, T_world_vehicle_from_planar(car.pose))
    corners_px = corners_px + NOISE_PX * jax.random.normal(key, corners_px.shape)
    speed_mps, steering_rad = read_odometry(car, OdometryNoise(), jax.random.fold_in(key, 1))
    return car, jn.Observation(corners_px, visible, speed_mps, steering_rad, dt_s)


def drive(navigator: jn.Navigator, duration_s: float):
    """Yield (time_s, error_m, output) of every frame until the last waypoint."""
    start, zero = jnp.asarray(jn.load_route(QCAR / "route.yaml").start_pose), jnp.zeros(())
    state, car, command = navigator.init(), CarState(start, zero, zero), jn.Command(zero, zero)
    for frame, key in enumerate(jax.random.split(jax.random.key(0), round(duration_s / PERIOD_S))):
        car, obs = simulate(navigator, car, command, jnp.asarray(PERIOD_S if frame else 0.0), key)
        state, out = jitted_step(navigator, state, obs)
        yield frame * PERIOD_S, float(jnp.linalg.norm((out.pose - car.pose)[:2])), out
        if out.done:
            return
        command = out.command


def main(duration_s: float = 20.0):
    """Print some frames: not told where the car starts, it explores until one pose is left."""
    for frame, (time_s, error_m, out) in enumerate(drive(make_navigator(), duration_s)):
        if frame % 10 == 0 or out.done:
            doubt = f"off by {100 * error_m:4.1f} cm  P(flip) {out.flip_probability:7.1e}"
            print(f"{time_s:5.2f} s  {doubt}", " at {:.2f} m {:.2f} m {:.2f} rad".format(*out.pose))
    return time_s, error_m, out


if __name__ == "__main__":
    main()
