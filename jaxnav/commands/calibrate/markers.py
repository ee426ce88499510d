"""`jaxnav calibrate markers`: find the places of markers with a calibrated rig."""

from jaxnav.calibrate.rig.calibrate import calibrate_rig
from jaxnav.calibrate.rig.views import Ts_vehicle_camera
from jaxnav.commands.calibrate.arguments import CalibrateMarkers as Arguments
from jaxnav.commands.calibrate.data import read_rig_data
from jaxnav.commands.calibrate.rig import publish, refuse_wrong_sizes
from jaxnav.commands.process import configure_jax


def run(args: Arguments) -> int:
    """Find the markers, write the files, and print a summary."""
    configure_jax(float64=True)
    data = read_rig_data(args.recordings, args.rig, args.markers, args.marker_size_m, args.family)
    given = Ts_vehicle_camera(data.rig)
    calibration = calibrate_rig(data.views, data.rig, data.known, None)
    refuse_wrong_sizes(data, calibration)
    publish(args.out, data, calibration, given, with_rig=False)
    return 0
