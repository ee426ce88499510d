"""`jaxnav doctor`: is what a car will run with in order, and what is to be done about it?

Any part may be broken, so that each check is imported only when its turn comes.
"""

import importlib
from collections.abc import Iterable
from functools import partial
from pathlib import Path
from typing import Any

from jaxnav.commands.doctor.findings import Finding, Report
from jaxnav.commands.drive.arguments import Doctor
from jaxnav.commands.kinds import key_values

_FILES = ("rig", "markers", "vehicle", "route")


def run(args: Doctor) -> int:
    """Examine computer, files, pictures, plug-ins and stamps, in this order, and sum up."""
    report = Report()

    def look(name: str, place: str, *told: Any) -> None:
        """Run the check MODULE:FUNCTION, unless what it is told is missing."""
        if all(one is not None for one in told):
            report.examine(name, partial(_look, place, *told))

    look("packages", "computer:packages")
    look("OpenCV", "computer:opencv")
    look("JAX", "computer:configured_jax")
    look("clock", "computer:clock")
    look("CPU", "computer:processor")
    look("disk", "computer:disk", Path.cwd())
    files: dict[str, Any] = {}
    report.examine("files", partial(_read_files, report, args, files))
    rig, markers, vehicle, route = (files.get(name) for name in _FILES)
    look("rig", "car_files:rig_file", rig)
    look("markers", "car_files:placed", markers)
    look("vehicle", "car_files:vehicle_file", vehicle)
    look("route", "car_files:route_file", route, vehicle, markers)
    look("sight", "car_files:sight_along", rig, markers, route)
    look("compile cache", "computer:jax_cache")
    frames = key_values("--frame", args.frame) or None
    look("picture", "photographs:pictures", frames, files)
    if args.car is not None or args.cameras is not None:
        look("plug-ins", "plug_ins:plug_ins", args, report, files)
    look("stamps", "plug_ins:stamps", args.drive)
    print(report.summary())
    if args.json is not None:
        from jaxnav.files import write_json

        write_json(args.json, report.as_json())
    return report.exit_code


def _look(place: str, *told: Any) -> Iterable[Finding]:
    module, _, name = place.partition(":")
    check = getattr(importlib.import_module(f"jaxnav.commands.doctor.{module}"), name)
    findings: Iterable[Finding] = check(*told)
    return findings


def _read_files(report: Report, args: Doctor, content: dict[str, Any]) -> tuple[()]:
    """Read rig, markers, vehicle and route into `content`; none of what can't be read."""
    from jaxnav import files

    def load(name: str) -> tuple[()]:
        path = getattr(args, name) or files.calib_dir() / "qcar" / f"{name}.yaml"
        content[name] = getattr(files, f"load_{name}")(path)
        return ()

    for name in _FILES:
        report.examine(name, partial(load, name))
    if "markers" in content and "route" in content:
        content["route"] = content["route"].relative_to(content["markers"].origin_m)
    return ()
