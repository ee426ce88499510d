"""Where the first of the two poses is farthest off: still pictures of the demo from many starts.

Run with `python benchmarks/bench_demo_starts.py`; it prints README-demo-starts.md, and takes some
minutes.
"""

import jax.numpy as jnp
import numpy as np

import jaxnav
from jaxnav.commands.simulate.arguments import Demo
from jaxnav.commands.simulate.demo import OPENCV, START_SPREAD, Method, make_methods
from jaxnav.commands.simulate.rendered_world import RenderedCameras, RenderedWorld
from jaxnav.core.models.geometry import wrap_angle_np
from jaxnav.core.pose.observation import Observation
from jaxnav.sim.scores import WRONG_DEG

DISTANCES_M = (2.0, 2.5, 3.0, 3.5)  # from the marker
ASIDE_DEG = (-30, -20, -10, 0, 10, 20, 30, 40)  # of its normal, positive where the waypoints are
PICTURES = 20

HEAD = f"""# Starts of the demo

`python benchmarks/bench_demo_starts.py`: the pose that OpenCV's corners and the first of the two
IPPE poses give from one picture of a car at rest, its place and heading spread as the demo spreads
them, {PICTURES} pictures a place. The car faces the first waypoint.

RMS error of the position in m (part of the pictures in which the marker was found; part of those
whose heading is more than {WRONG_DEG:.0f} degrees off):
"""


def main() -> None:
    """Print the table, and the place that the demo's rule chooses."""
    jaxnav.configure(float64=True, threads=1)
    world = RenderedWorld.load(Demo(headless=True))
    _, opencv = make_methods(Demo(headless=True), world)
    print(HEAD)
    print("| degrees off the normal | " + " | ".join(f"{d} m" for d in DISTANCES_M) + " |")
    print("|" + " --- |" * (len(DISTANCES_M) + 1))
    best = (0.0, "")
    for aside_deg in ASIDE_DEG:
        cells = []
        for distance_m in DISTANCES_M:
            start = start_at(world, distance_m, np.deg2rad(aside_deg))
            rms_m, found, wrong = first_poses(world, opencv, start)
            cells.append(f"{rms_m:.2f} ({found:.0%}; {wrong:.0%})")
            if found > 0.5:
                best = max(best, (rms_m, f"{distance_m} m, {aside_deg} degrees: {start.round(3)}"))
        print(f"| {aside_deg} | " + " | ".join(cells) + " |", flush=True)
    print(f"\nFarthest off where more than half of the pictures show it: {best[1]} (m, m, rad).")


def start_at(world: RenderedWorld, distance_m: float, aside_rad: float) -> np.ndarray:
    """Planar pose (3,) at a place before the marker, facing the first waypoint: m m rad."""
    T_world_marker = np.asarray(world.setup.markers.Ts_world_marker.as_matrix())[0]
    normal_rad = np.arctan2(*T_world_marker[:2, 2][::-1]) + aside_rad
    place_m = T_world_marker[:2, 3] + distance_m * np.array(
        [np.cos(normal_rad), np.sin(normal_rad)]
    )
    ahead_m = np.asarray(world.setup.route_on_map.waypoints_m)[0] - place_m
    return np.append(place_m, np.arctan2(ahead_m[1], ahead_m[0]))


def first_poses(
    world: RenderedWorld, opencv: Method, start: np.ndarray
) -> tuple[float, float, float]:
    """RMS error of the position, m; part found; part of those that are wrong."""
    rng = np.random.default_rng(0)
    cameras = RenderedCameras(world, opencv.detectors, rng)
    errors_m, turned = [], []
    for _ in range(PICTURES):
        x_m, y_m, psi_rad = pose = start + START_SPREAD * rng.uniform(-1, 1, 3)
        rest = np.array([np.cos(psi_rad / 2), 0, 0, np.sin(psi_rad / 2), x_m, y_m, 0])
        corners_px, visible, sigma_px = cameras.look(
            lambda times_s, rest=rest: np.broadcast_to(rest, (len(times_s), 7)), 0.0, None
        )
        if not visible.any():
            continue
        seen = Observation(
            corners_px=jnp.asarray(corners_px),
            visible=jnp.asarray(visible),
            dt_s=jnp.asarray(0.0),
            corner_sigma_px=jnp.asarray(sigma_px),
        )
        opencv.navigator.reset()
        outputs, _ = opencv.navigator.step(seen, jnp.asarray(pose))
        error = np.asarray(outputs[OPENCV].pose) - pose
        errors_m.append(np.hypot(error[0], error[1]))
        turned.append(error[2])
    if not errors_m:
        return float("nan"), 0.0, float("nan")
    rms_m = np.sqrt(np.mean(np.square(errors_m)))
    wrong = np.mean(np.rad2deg(np.abs(wrap_angle_np(np.array(turned)))) > WRONG_DEG)
    return float(rms_m), len(errors_m) / PICTURES, float(wrong)


if __name__ == "__main__":
    main()
