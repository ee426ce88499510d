"""A vehicle and cameras of one's own, as plug-ins of the loop that drives.

A driver answers `read`, `write`, `stop` and `close`, a camera `read` and `close`; see
`jaxnav.loop.interfaces`. Here both are simulated; a real driver talks to its hardware instead.

    python examples/own_vehicle.py                  # a second, as fast as the machine can
    cd examples && jaxnav run --vehicle own_vehicle:open_vehicle --cameras own_vehicle:open_cameras
"""

import math
import time

import jax
import numpy as np
from drive import QCAR, make_navigator  # examples/drive.py

import jaxnav as jn
from jaxnav.detection.types import Detections
from jaxnav.loop.frames import FrameDetections
from jaxnav.loop.interfaces import Frame, Odometry, Setup
from jaxnav.loop.pilot import Input, Pilot
from jaxnav.models.geometry import T_world_vehicle_from_planar
from jaxnav.simulation.corners import see

NOISE_PX, PERIOD_S = 0.3, 1 / 30  # of a corner's coordinate; of the cameras
look = jax.jit(lambda rig, markers, pose: see(rig, markers, T_world_vehicle_from_planar(pose)))


class MyCar:
    """Takes its speed and its steering angle at once."""

    timeout_s = 0.2  # after so long without a `write` it stops by itself

    def __init__(self, setup: Setup, now_ns=time.monotonic_ns):
        self.now_ns, self.pose = now_ns, np.array(setup.start_pose)  # x_m, y_m, psi_rad
        self._wheelbase_m = float(setup.vehicle.wheelbase_m)
        self._speed_per_throttle_mps = float(setup.vehicle.speed_per_throttle_mps)
        self._speed_mps = self._steering_rad = 0.0
        self._moved_ns = self._written_ns = now_ns()

    def read(self) -> Odometry:
        """Move up to now, and say how fast."""
        now_ns = self.now_ns()
        if now_ns - self._written_ns > self.timeout_s * 1e9:
            self._speed_mps = 0.0
        beta_rad = math.atan(math.tan(self._steering_rad) / 2)
        course_rad, turn_per_m = self.pose[2] + beta_rad, 2 * math.sin(beta_rad) / self._wheelbase_m
        way_m = self._speed_mps * (now_ns - self._moved_ns) / 1e9
        moved = way_m * np.array([math.cos(course_rad), math.sin(course_rad), turn_per_m])
        self.pose, self._moved_ns = self.pose + moved, now_ns
        return Odometry(now_ns, self._speed_mps, self._steering_rad)

    def write(self, steering_rad: float, throttle: float) -> None:
        """Throttle is in the driver's unit; vehicle.yaml says what speed it makes."""
        self.read()
        self._written_ns, self._steering_rad = self.now_ns(), steering_rad
        self._speed_mps = throttle * self._speed_per_throttle_mps

    def stop(self) -> None:
        """Zero throttle."""
        self._speed_mps = 0.0

    close = stop


class MyCamera:
    """Finds its markers itself; one that gives `Frame(stamp_ns, image)` need not."""

    def __init__(self, setup: Setup, index: int, car: MyCar):
        self.name, self._index, self._setup, self._car = setup.rig.names[index], index, setup, car
        self._rng, self._due_ns = np.random.default_rng(index), car.now_ns()

    def read(self, timeout_s: float) -> Frame | None:
        """The next frame, None where there is none within the time."""
        time.sleep(min(max(self._due_ns - self._car.now_ns(), 0) / 1e9, timeout_s))
        stamp_ns, markers = self._car.now_ns(), self._setup.markers
        if stamp_ns < self._due_ns:
            return None
        self._due_ns = stamp_ns + int(PERIOD_S * 1e9)
        corners_px, visible = jax.device_get(look(self._setup.rig, markers, self._car.pose))
        seen = np.flatnonzero(visible[self._index])
        noise_px = NOISE_PX * self._rng.normal(size=(len(seen), 4, 2))
        ids, families = np.array(markers.ids)[seen], tuple(markers.families[m] for m in seen)
        sigma_px, refined = np.full((len(seen), 4), NOISE_PX), np.ones(len(seen), bool)
        found = Detections(
            ids, corners_px[self._index, seen] + noise_px, sigma_px, refined, families
        )
        return Frame(stamp_ns, detections=found)

    def close(self) -> None:
        """Nothing is held."""


def open_vehicle(setup: Setup) -> MyCar:
    """The factory that an entry point of the group `jaxnav.vehicles`, or `--vehicle`, names."""
    return MyCar(setup)


open_vehicle.shares_process = True  # the cameras look from where the car itself is


def open_cameras(setup: Setup, vehicle: MyCar) -> list[MyCamera]:
    """One for each of the rig: of the group `jaxnav.cameras`."""
    return [MyCamera(setup, index, vehicle) for index in range(len(setup.rig))]


def main(duration_s: float = 1.0, selector: jn.Selector | None = None) -> dict[str, float | str]:
    """Step the loop's pilot on a clock of our own, 50 times a second."""
    navigator, start_pose = make_navigator(selector), jn.load_route(QCAR / "route.yaml").start_pose
    setup = Setup(navigator.rig, navigator.markers, navigator.motion.vehicle, start_pose)
    time_ns = 1_000_000_000
    car = MyCar(setup, lambda: time_ns)
    cameras, pilot = open_cameras(setup, car), Pilot(navigator)
    for time_ns in range(time_ns, time_ns + int(duration_s * 1e9), 20_000_000):  # noqa: B020
        frames = [camera.read(0.0) for camera in cameras]
        sighted = [FrameDetections(c, f.stamp_ns, f.detections) for c, f in enumerate(frames) if f]
        outcome = pilot.handle(Input(time_ns, car.read(), tuple(sighted)))
        car.write(outcome.steering_rad, outcome.throttle)
    moved_m, error_m = (float(np.hypot(*(car.pose - p)[:2])) for p in (start_pose, outcome.pose))
    print(f"{duration_s:.1f} s: {outcome.health.name}, moved {moved_m:.2f} m,", end=" ")
    print(f"estimate off by {100 * error_m:.1f} cm")
    return {"moved_m": moved_m, "error_m": error_m, "health": outcome.health.name}


if __name__ == "__main__":
    main()
