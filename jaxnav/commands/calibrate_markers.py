"""`jaxnav calibrate markers`: where the markers are, by a rig that is calibrated."""

import numpy as np

from jaxnav.arguments.calibration import CalibrateMarkers as Arguments
from jaxnav.calibration.linking import inverted
from jaxnav.calibration.rig import calibrate_rig
from jaxnav.commands.calibrate_rig import refuse_wrong_sizes, write_picture
from jaxnav.commands.calibration_data import gathered
from jaxnav.commands.calibration_report import provenance, summary, text, write_files
from jaxnav.commands.process import configure_jax
from jaxnav.files import output_folder, write_json


def run(args: Arguments) -> int:
    """Find, write, and say in a few lines what came of it."""
    configure_jax(float64=True)
    data = gathered(args.recordings, args.rig, args.markers_file, args.marker_size_m, args.family)
    given = inverted(np.asarray(data.rig.Ts_camera_vehicle.as_matrix(), float))
    found = calibrate_rig(data.views, data.rig, data.known, None)
    refuse_wrong_sizes(data, found)
    out = output_folder(args.out)
    calibrated = provenance(data, "markers")
    report = summary(data, found, given, calibrated)
    write_files(out, data, found, calibrated, with_rig=False)
    write_json(out / "report.json", report)
    write_picture(out, data, found, given)
    print(text(report))
    print(f"markers and report in {out}")
    return 0
