"""`jaxnav doctor`: is what a car will run with in order, and what is to be done about it?

Any part may be broken, so that each check is imported only when its turn comes.
"""

import importlib
from collections.abc import Iterable
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

from jaxnav.commands.doctor.arguments import Doctor
from jaxnav.commands.doctor.findings import Finding, Report, note
from jaxnav.commands.kinds import key_values
from jaxnav.errors import BadInput

_CHECKS = "jaxnav.commands.doctor"


def run(args: Doctor) -> int:
    """Examine computer, files, pictures, plug-ins and stamps, in this order, and sum up."""
    report = Report(lambda finding: print(finding, flush=True))
    _computer(report)
    patient = _files(report, args)
    report.examine("compile cache", _cache, patient)
    if args.frame:
        report.examine("picture", _pictures, args, patient)
    if args.car is not None or args.cameras is not None:
        report.examine("plug-ins", _plug_ins, report, args, patient)
    if args.drive is not None:
        report.examine("stamps", _check, "stamps", "stamps", args.drive)
    print(report.summary())
    if args.json is not None:
        from jaxnav.files import write_json

        write_json(args.json, report.as_json())
    return report.exit_code


def _check(module: str, name: str, *told: Any) -> Iterable[Finding]:
    """Import a module of checks and call one of its functions."""
    check = getattr(importlib.import_module(f"{_CHECKS}.{module}"), name)
    findings: Iterable[Finding] = check(*told)
    return findings


def _computer(report: Report) -> None:
    report.examine("packages", _check, "software", "packages")
    report.examine("OpenCV", _check, "software", "opencv")
    report.examine("JAX", _jax)
    report.examine("clock", _check, "machine", "clock")
    report.examine("CPU", _check, "machine", "processor")
    report.examine("disk", _check, "machine", "disk", Path.cwd())


def _jax() -> Iterable[Finding]:
    """Examine JAX, configured as the car will be started: one thread, float64."""
    process = importlib.import_module("jaxnav.commands.process")
    process.configure_jax(float64=True, threads=1)
    return _check("software", "jax_device")


def _files(report: Report, args: Doctor) -> SimpleNamespace:
    """Read and examine rig, markers, vehicle and route; None for each that can't be read."""
    patient = SimpleNamespace(rig=None, markers=None, vehicle=None, route=None)
    files = report.read("files", lambda: importlib.import_module("jaxnav.files"))
    if files is None:
        return patient
    qcar = files.calib_dir() / "qcar"
    paths = {
        "rig": args.rig or qcar / "rig.yaml",
        "markers": args.markers or qcar / "markers.yaml",
        "vehicle": args.vehicle or qcar / "vehicle.yaml",
        "route": args.route or qcar / "route.yaml",
    }
    for name, path in paths.items():
        setattr(patient, name, report.read(name, partial(getattr(files, f"load_{name}"), path)))
    if patient.markers is not None and patient.route is not None:
        patient.route = patient.route.relative_to(patient.markers.origin_m)
    rig, markers, vehicle, route = vars(patient).values()
    if rig is not None:
        report.examine("rig", _check, "rig_file", "rig_file", paths["rig"], rig)
    report.examine("markers", _check, "markers_file", "measured_corners", paths["markers"])
    if markers is not None:
        report.examine("markers", _check, "markers_file", "placed", markers)
    if vehicle is not None:
        report.examine("vehicle", _check, "route_file", "vehicle_file", vehicle)
    if None not in (route, vehicle, markers):
        report.examine("route", _check, "route_file", "route_file", route, vehicle, markers)
    if None not in (rig, route, markers):
        report.examine("sight", _check, "route_file", "sight_along", rig, markers, route)
    return patient


def _cache(patient: SimpleNamespace) -> Iterable[Finding]:
    """Report whether the program that a car runs with these files is compiled."""
    import jax

    from jaxnav.files.configuration import cache_refused, step_folder

    folder, compiled = step_folder(), None
    if folder is not None and None not in vars(patient).values():
        compiled = _is_compiled(patient, folder)
    directory = jax.config.jax_compilation_cache_dir  # type: ignore[attr-defined]
    directory = Path(directory) if directory else None
    return _check("software", "compile_cache", directory, compiled, cache_refused())


def _is_compiled(patient: SimpleNamespace, folder: Path) -> bool:
    """Whether the step is compiled as `jaxnav run` would look for it: in single precision."""
    import equinox as eqx
    import jax
    import jax.numpy as jnp
    import numpy as np

    from jaxnav.core.navigator import Navigator
    from jaxnav.drive.compiled_step import is_compiled
    from jaxnav.drive.estimator import Estimator, advance_packed

    with jax.enable_x64(False):
        rig, markers, vehicle = jax.tree.map(
            lambda leaf: jnp.asarray(np.asarray(leaf)) if eqx.is_array(leaf) else leaf,
            (patient.rig, patient.markers, patient.vehicle),
        )
        navigator = Navigator(
            rig=rig,
            markers=markers,
            vehicle=vehicle,
            waypoints_m=patient.route.waypoints_m,
            waypoint_radius_m=patient.route.waypoint_radius_m,
        )
        asked: list[tuple[Any, ...]] = []  # with what the estimator would call it
        Estimator(navigator, program=lambda *arguments: asked.append(arguments)).warm_up()  # type: ignore
        return all(
            is_compiled(advance_packed, navigator, folder, *arguments) for arguments in asked
        )


def _pictures(args: Doctor, patient: SimpleNamespace) -> Iterable[Finding]:
    from jaxnav.commands.doctor.photographs import examine_pictures
    from jaxnav.files.images import read_image

    if patient.rig is None or patient.markers is None:
        return [note("not looked at: rig and markers are needed")]
    images = {}
    for name, path in key_values("--frame", args.frame).items():
        if name not in patient.rig.names:
            known = ", ".join(patient.rig.names)
            problem = f"the rig has no camera {name!r}: expected one of {known}"
            raise BadInput(f"--frame {name}={path}", problem)
        images[name] = read_image(Path(path))
    return examine_pictures(patient.rig, patient.markers, patient.route, images)


def _plug_ins(report: Report, args: Doctor, patient: SimpleNamespace) -> Iterable[Finding]:
    if None in vars(patient).values():
        return [note("not opened: they need all four files")]
    from jaxnav.commands.doctor.plug_ins import plug_ins
    from jaxnav.drive.interfaces import Setup

    options = key_values("--option", args.option)
    setup = Setup(
        patient.rig, patient.markers, patient.vehicle, patient.route.start_pose, options=options
    )
    plug_ins(report, setup, args.car, args.cameras)
    return ()
