"""`jaxnav doctor`: is what a car will run with in order, and what is to be done about it?

Any part may be broken, so that each check is imported only when its turn comes.
"""

import importlib
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

from jaxnav.commands.doctor.arguments import Doctor
from jaxnav.commands.doctor.findings import Finding, Report
from jaxnav.commands.kinds import key_values

# What is looked at, the module and function that do it, and what that is given. A check is left out
# where a part of that is None: a flag that is not given, a file that can't be read. With a question
# mark it may be.
Check = tuple[str, str, tuple[str, ...]]
COMPUTER: tuple[Check, ...] = (
    ("packages", "computer:packages", ()),
    ("OpenCV", "computer:opencv", ()),
    ("JAX", "computer:configured_jax", ()),
    ("clock", "computer:clock", ()),
    ("CPU", "computer:processor", ()),
    ("disk", "computer:disk", ("folder",)),
)
CAR: tuple[Check, ...] = (
    ("rig", "rig_file:rig_file", ("rig",)),
    ("markers", "markers_file:measured_corners", ("markers_path",)),
    ("markers", "markers_file:placed", ("markers",)),
    ("vehicle", "route_file:vehicle_file", ("vehicle",)),
    ("route", "route_file:route_file", ("route", "vehicle", "markers")),
    ("sight", "route_file:sight_along", ("rig", "markers", "route")),
    ("compile cache", "computer:jax_cache", ()),
    ("picture", "photographs:pictures", ("frames", "rig?", "markers?", "route?")),
    ("plug-ins", "plug_ins:plug_ins",
     ("report", "plug_ins", "rig?", "markers?", "vehicle?", "route?")),
    ("stamps", "cameras:stamps", ("drive",)),
)  # fmt: skip


def run(args: Doctor) -> int:
    """Examine computer, files, pictures, plug-ins and stamps, in this order, and sum up."""
    report = Report(lambda finding: print(finding, flush=True))
    named = args.car is not None or args.cameras is not None
    given = {
        "folder": Path.cwd(),
        "report": report,
        "frames": key_values("--frame", args.frame) or None,
        "plug_ins": (args.car, args.cameras, key_values("--option", args.option))
        if named
        else None,
        "drive": args.drive,
    }
    _examine(report, COMPUTER, given)
    report.examine("files", partial(_read_files, report, args, given))
    _examine(report, CAR, given)
    print(report.summary())
    if args.json is not None:
        from jaxnav.files import write_json

        write_json(args.json, report.as_json())
    return report.exit_code


def _examine(report: Report, checks: tuple[Check, ...], given: dict[str, Any]) -> None:
    for name, place, asked in checks:
        told = [given.get(one.rstrip("?")) for one in asked]
        if all(one is not None or key.endswith("?") for one, key in zip(told, asked, strict=True)):
            report.examine(name, partial(_look, place, *told))


def _look(place: str, *told: Any) -> Iterator[Finding]:
    module, _, name = place.partition(":")
    check = getattr(importlib.import_module(f"jaxnav.commands.doctor.{module}"), name)
    findings: Iterator[Finding] = check(*told)
    return findings


def _read_files(report: Report, args: Doctor, given: dict[str, Any]) -> tuple[()]:
    """Read rig, markers, vehicle and route into what is given; none of what can't be read."""
    from jaxnav import files

    def load(name: str, path: Path) -> tuple[()]:
        given[name] = getattr(files, f"load_{name}")(path)
        return ()

    for name in ("rig", "markers", "vehicle", "route"):
        path = getattr(args, name) or files.calib_dir() / "qcar" / f"{name}.yaml"
        given[f"{name}_path"] = path
        report.examine(name, partial(load, name, path))
    if "markers" in given and "route" in given:
        given["route"] = given["route"].relative_to(given["markers"].origin_m)
    return ()
