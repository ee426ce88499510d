"""Test whether a plug-in keeps the promises of `jaxnav.drive.interfaces`. Call it from pytest:

    def test_my_car():
        check_vehicle(open_vehicle, setup)

The test really drives: lift the car off the ground, its wheels turn at full throttle for a moment.
"""

from jaxnav.vehicles.conformance.cameras import check_cameras
from jaxnav.vehicles.conformance.vehicle import check_vehicle

__all__ = ["check_cameras", "check_vehicle"]
