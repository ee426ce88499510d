"""A vehicle of one's own, as a plug-in of the loop that drives: see `jaxnav.drive.interfaces`.

    python examples/own_vehicle.py                  # does it keep what a vehicle promises?
    PYTHONPATH=examples jaxnav run --car own_vehicle:MyCar --cameras sim

Here it talks to a simulated world, at which the cameras look too; a real one to its hardware.
"""

import time

from drive import QCAR, make_navigator  # examples/drive.py

import jaxnav as jn
from jaxnav.drive.interfaces import Odometry, Setup
from jaxnav.vehicles.conformance import check_vehicle
from jaxnav.vehicles.world import SimWorld


class MyCar:
    """Its constructor is what `--car`, or an entry point of `jaxnav.vehicles`, names."""

    shares_process = True  # the cameras look at its world
    timeout_s = 0.2  # after so long without a `write` it stops by itself

    def __init__(self, setup: Setup):
        start_ns = time.monotonic_ns()
        self.world = SimWorld(setup.rig, setup.markers, setup.vehicle, setup.start_pose, start_ns)
        self.world.detections(start_ns + 1)  # compiled now, and not while the loop waits

    def read(self) -> Odometry:
        """The speed and the steering angle, as far as its sensors know."""
        now_ns = time.monotonic_ns()
        return Odometry(now_ns, *self.world.odometry(now_ns))

    def write(self, steering_rad: float, throttle: float) -> None:
        """Throttle is in the driver's unit; vehicle.yaml says what speed it makes."""
        self.world.write(steering_rad, throttle, time.monotonic_ns())

    def stop(self) -> None:
        """Zero throttle."""
        self.write(0.0, 0.0)

    close = stop


def main() -> None:
    """Check its promises, then drive it for half a second."""
    navigator, route = make_navigator(), jn.load_route(QCAR / "route.yaml")
    setup = Setup(navigator.rig, navigator.markers, navigator.motion.vehicle, route.start_pose)
    check_vehicle(MyCar, setup)
    print("it keeps what jaxnav.drive.interfaces.Vehicle promises")
    car = MyCar(setup)
    for _ in range(10):
        car.write(0.1, 0.05)
        time.sleep(0.05)
    print(f"throttle 0.05 for half a second makes {car.read().speed_mps:.2f} m/s")


if __name__ == "__main__":
    main()
