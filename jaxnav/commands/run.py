"""`jaxnav run`: the loop that drives, with all that looks on."""

import gc
import os
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import jax
import numpy as np

from jaxnav.arguments import Run
from jaxnav.commands.observers import open_onlookers
from jaxnav.commands.process import configure_jax, step_folder
from jaxnav.detection import make_detectors
from jaxnav.errors import BadInput
from jaxnav.executables import keep_in
from jaxnav.files import calib_dir, load_markers, load_params, load_rig, load_route, load_vehicle
from jaxnav.runtime import plugins
from jaxnav.runtime.corrections import Corrections
from jaxnav.runtime.drive_setup import DriveSetup
from jaxnav.runtime.guard import Guard
from jaxnav.runtime.interfaces import HasOwnFiles, Setup
from jaxnav.runtime.loop import Loop, Observer
from jaxnav.runtime.pilot import Pilot
from jaxnav.runtime.seeing import Eyes, Search

EXIT_STOPPED = 1  # by the watchdog, not by a person
EXIT_SIGNAL = 128


def run(args: Run) -> int:
    """Drive, and say why it ended."""
    configure_jax(float64=args.float64, threads=1)
    keep_in(step_folder())
    options = _options(args.option)
    setup = _setup(args, options)
    if args.params is not None:
        params = load_params(args.params)
        setup = setup.with_params(params)
        _say(args, params.told())
    searches = _searches(args, setup)
    with ExitStack() as closing:
        onlookers = open_onlookers(args, setup, closing)
        pilot = _compiled(args, setup, searches)
        start_pose = setup.route_on_map.start_pose
        told = Setup(setup.rig, setup.markers, setup.vehicle, start_pose, args.seed, options)
        loop, eyes, reason = _drive(args, pilot, told, searches, onlookers)
    _summarise(loop, eyes, reason)
    for onlooker in onlookers:
        if onlooker.told is not None:
            print(onlooker.told)
    if loop.guard.signal is not None:
        return EXIT_SIGNAL + loop.guard.signal
    return EXIT_STOPPED if loop.stopped else 0


def _options(given: Sequence[str]) -> dict[str, str]:
    options = {}
    for text in given:
        key, equals, value = text.partition("=")
        if not equals or not key:
            raise BadInput("--option", f"expected KEY=VALUE, got {text!r}")
        if key in options:
            raise BadInput("--option", f"{key} is given twice")
        options[key] = value
    return options


def _setup(args: Run, options: Mapping[str, str]) -> DriveSetup:
    """Read all files and find all plug-ins first: bad input is found before anything is compiled,
    let alone moves."""
    factory = plugins.find("--vehicle", plugins.VEHICLES, args.vehicle)
    plugins.find("--cameras", plugins.CAMERAS, args.cameras or args.vehicle)
    own = factory.own_files(options) if isinstance(factory, HasOwnFiles) else None
    qcar = calib_dir() / "qcar"

    def chosen(name: str, path: Path | None, load: Callable[[Path], Any]) -> Any:
        if path is None and own is not None:
            return getattr(own, name)
        return load(path or qcar / f"{name}.yaml")

    return DriveSetup(
        rig=chosen("rig", args.rig, load_rig),
        markers=chosen("markers", args.markers, load_markers),
        vehicle=chosen("vehicle", args.vehicle_file, load_vehicle),
        route=chosen("route", args.route, load_route),
        selector=args.selector,
        float64=args.float64,
    )


def _searches(args: Run, setup: DriveSetup) -> list[Search]:
    """One for each camera."""
    detectors = make_detectors(setup.markers, args.corner_backend)
    rig = jax.device_get(setup.rig)  # of which NumPy takes a camera without compiling anything
    return [Search(c, rig.image_sizes_px[c], rig.camera(c), detectors) for c in range(len(rig))]


def _compiled(args: Run, setup: DriveSetup, searches: Sequence[Search]) -> Pilot:
    """A pilot that need not compile any more, nor need those who look for markers."""
    _say(args, "compiling")
    began_s = time.monotonic()
    with ThreadPoolExecutor(1) as beside:
        looked = beside.submit(searches[0].warm_up)
        pilot = setup.pilot(step_folder())
        pilot.warm_up()
        looked.result()
    _say(args, f"compiled in {time.monotonic() - began_s:.1f} s")
    return pilot


def _drive(
    args: Run, pilot: Pilot, told: Setup, searches: list[Search], onlookers: Sequence[Observer]
) -> tuple[Loop, Eyes, str]:
    """Open what moves, drive, stop and let go of it. Also: why it ended."""
    duration_s = args.duration_s if args.duration_s is not None else float("inf")
    with ExitStack() as closing:
        # Python looks through all objects now and then: not through those of JAX, 50 ms a time.
        gc.freeze()
        closing.callback(gc.unfreeze)
        vehicle = plugins.open_vehicle(args.vehicle, told)
        corrections = Corrections.of(told.vehicle)
        guard = Guard(vehicle, pilot.limits, args.timeout_s, corrections=corrections)
        closing.callback(guard.close)
        guard.watch_signals()
        cameras = plugins.open_cameras(args.cameras or args.vehicle, told, vehicle)
        eyes = Eyes(cameras, searches, guard, workers=max(1, os.cpu_count() or 1))
        closing.callback(eyes.close)
        # Before the eyes are closed, for which their threads may take a while.
        closing.callback(guard.trip, "the drive is over")
        loop = Loop(pilot, guard, vehicle, eyes, onlookers, args.period_s)
        reason = loop.run(duration_s)
    return loop, eyes, reason


def _say(args: Run, text: str) -> None:
    if not args.headless:
        sys.stderr.write(f"{text}\n")


def _summarise(loop: Loop, eyes: Eyes, reason: str) -> None:
    print(f"ended: {reason}")
    statistics = loop.statistics
    for name in sorted(statistics.counts):
        median, late = (statistics.quantile_ms(name, share) for share in (0.5, 0.99))
        count = int(statistics.counts[name].sum())
        print(f"{name}: {count}, {median:.2f} ms median, {late:.2f} ms 99 %")
    print(
        f"deadlines missed: {statistics.deadlines_missed}; frames dropped: {eyes.dropped}; "
        f"camera errors: {int(np.sum(eyes.errors))}"
    )
