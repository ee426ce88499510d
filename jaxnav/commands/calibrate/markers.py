"""`jaxnav calibrate markers`: where the markers are, by a rig that is calibrated."""

import numpy as np

from jaxnav.calibration.rigs.calibrate import calibrate_rig
from jaxnav.calibration.rigs.linking import inverted
from jaxnav.commands.calibrate.arguments.recordings import CalibrateMarkers as Arguments
from jaxnav.commands.calibrate.data import gathered
from jaxnav.commands.calibrate.rig import publish, refuse_wrong_sizes
from jaxnav.commands.process import configure_jax


def run(args: Arguments) -> int:
    """Find, write, and say in a few lines what came of it."""
    configure_jax(float64=True)
    data = gathered(args.recordings, args.rig, args.markers_file, args.marker_size_m, args.family)
    given = inverted(np.asarray(data.rig.Ts_camera_vehicle.as_matrix(), float))
    found = calibrate_rig(data.views, data.rig, data.known, None)
    refuse_wrong_sizes(data, found)
    publish(args.out, data, found, given, with_rig=False)
    return 0
