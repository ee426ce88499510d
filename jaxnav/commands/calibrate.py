"""`jaxnav calibrate`: the figures of one's own car."""

import importlib

from jaxnav.arguments.calibration import CALIBRATIONS, Calibrate


def run(args: Calibrate) -> int:
    """What is to be calibrated."""
    name = next(name for name, command in CALIBRATIONS.items() if type(args.what) is command)
    module = importlib.import_module(f"jaxnav.commands.calibrate_{name}")
    code: int = module.run(args.what)
    return code
