"""Find and open vehicles and cameras by name: an installed entry point, or any `module:name`.

    vehicle = open_vehicle("qcar", setup)
    cameras = open_cameras("my_cameras:open_cameras", setup, vehicle)

Every problem of a plug-in is reported in one line for a person.
"""

import contextlib
import importlib
import traceback
from collections.abc import Callable, Sequence
from importlib.metadata import entry_points
from pathlib import Path
from typing import Any

from jaxnav.drive.interfaces import Camera, NeedsNoVehicle, Setup, Vehicle
from jaxnav.errors import BadInput

VEHICLES = "jaxnav.vehicles"
CAMERAS = "jaxnav.cameras"

# Modules that no package registry has, and where they come from.
_COMES_WITH = {
    "pal": "it comes with Quanser's software for the QCar: put its folder on PYTHONPATH",
    "quanser": "it comes with Quanser's software for the QCar, for that car's own Python",
    "rclpy": "it comes with ROS 2: source its setup.bash first",
    "nav_msgs": "it comes with ROS 2: source its setup.bash first",
    "ackermann_msgs": "it is a package of ROS 2: install ackermann-msgs and source setup.bash",
}


def open_vehicle(name: str, setup: Setup, factory: Callable[..., Any] | None = None) -> Vehicle:
    """Open a vehicle.

    Args:
        name: name of an entry point, or `module:name`.
        factory: what `load_factory` has found before; None: it is looked for.

    Raises:
        BadInput: there is none of that name, it can't be imported or opened, or it does not return
            a vehicle.
    """
    flag = "--car"
    vehicle: Vehicle = _opened(flag, name, factory or load_factory(flag, VEHICLES, name), setup)
    if lacking := missing_members(vehicle, Vehicle):
        _close([vehicle])
        raise BadInput(flag, f"{name} gives {_what(vehicle)}, which has no {_listed(lacking)}")
    return vehicle


def open_cameras(name: str, setup: Setup, vehicle: Vehicle | None) -> tuple[Camera, ...]:
    """Open the cameras of the rig, in its order.

    Args:
        name: name of an entry point, or `module:name`.

    Raises:
        BadInput: there is none of that name, it can't be imported or opened, or it does not return
            the rig's cameras.
    """
    flag = "--cameras"
    product = _opened(flag, name, load_factory(flag, CAMERAS, name), setup, vehicle)
    if not isinstance(product, Sequence) or isinstance(product, str | bytes):
        _close([product])
        raise BadInput(flag, f"{name} gives {_what(product)}, expected a sequence of cameras")
    cameras, names, problem = tuple(product), setup.rig.names, ""
    for index, camera in enumerate(cameras):
        if lacking := missing_members(camera, Camera):
            problem = f"{_what(camera)} as camera {index}, which has no {_listed(lacking)}"
            break
    else:
        if (given := tuple(camera.name for camera in cameras)) != names:
            problem = f"the cameras {_listed(given)}, expected those of the rig: {_listed(names)}"
    if problem:
        _close(cameras)
        raise BadInput(flag, f"{name} gives {problem}")
    return cameras


def try_cameras(name: str, setup: Setup) -> None:
    """Open cameras that need no vehicle, and close them again.

    Raises:
        BadInput: as `open_cameras`.
    """
    factory = load_factory("--cameras", CAMERAS, name)
    if isinstance(factory, NeedsNoVehicle) and factory.needs_no_vehicle:
        _close(open_cameras(name, setup, None))


def load_factory(flag: str, group: str, name: str) -> Callable[..., Any]:
    """Find the factory of a plug-in.

    Args:
        flag: command-line flag that the message names.
        group: group of entry points.
        name: name of one of them, or `module:name`.

    Raises:
        BadInput: there is none of that name, or it can't be imported or called.
    """
    installed = {point.name: point for point in entry_points(group=group)}
    target = installed[name].value if name in installed else name
    module, colon, attribute = target.partition(":")
    if not (colon and module and attribute):
        raise BadInput(
            flag,
            f"there is no {name!r}: expected {', '.join(sorted(installed)) or 'an installed name'}"
            " or module:name",
        )
    try:
        member: Any = importlib.import_module(module)
    except ImportError as error:
        raise _not_importable(flag, name, error) from error
    except (Exception, SystemExit) as error:  # it is foreign code
        raise BadInput(flag, f"{name}: importing {module} failed: {_said(error)}") from error
    for part in attribute.split("."):
        if not hasattr(member, part):
            raise BadInput(flag, f"{name}: the module {module} has no {attribute!r}")
        member = getattr(member, part)
    if not callable(member):
        raise BadInput(flag, f"{name}: {target} is {_what(member)}, expected a function")
    return member


def missing_members(opened: object, protocol: type) -> list[str]:
    """The members of a protocol that an object lacks, methods with brackets."""
    asked = {name: value for name, value in vars(protocol).items() if not name.startswith("_")}
    lacking = []
    for name, value in asked.items():
        if isinstance(value, property):
            if not hasattr(opened, name):
                lacking.append(name)
        elif callable(value) and not callable(getattr(opened, name, None)):
            lacking.append(f"{name}()")
    return lacking


def _opened(flag: str, name: str, factory: Callable[..., Any], *args: object) -> Any:
    try:
        return factory(*args)
    except ImportError as error:  # a factory may import its driver
        raise _not_importable(flag, name, error) from error
    except BadInput:
        raise
    except (Exception, SystemExit) as error:  # it is foreign code; its author needs the place
        where = "" if isinstance(error, OSError) else _place(error)
        raise BadInput(flag, f"{name} could not be opened: {_said(error)}{where}") from error


def _not_importable(flag: str, name: str, error: ImportError) -> BadInput:
    if not isinstance(error, ModuleNotFoundError) or error.name is None:
        return BadInput(flag, f"{name} could not be imported: {_said(error)}")
    top = error.name.partition(".")[0]
    hint = _COMES_WITH.get(top, "is it installed, or its folder on PYTHONPATH?")
    return BadInput(flag, f"{name} needs the module {error.name}, which is missing: {hint}")


def _close(things: Sequence[Any]) -> None:
    """Close what was opened and will not be used."""
    for thing in things:
        if callable(getattr(thing, "close", None)):
            with contextlib.suppress(OSError):
                thing.close()


def _what(thing: object) -> str:
    return "None" if thing is None else f"an object of the class {type(thing).__name__}"


def _listed(names: Sequence[object]) -> str:
    return ", ".join(map(str, names)) or "none"


def _place(error: BaseException) -> str:
    """The innermost line of Python that an error has come through, to follow its text."""
    *_, (frame, line) = traceback.walk_tb(error.__traceback__)
    return f" ({Path(frame.f_code.co_filename).name}:{line})"


def _said(error: BaseException) -> str:
    return f"{type(error).__name__}: {error}" if str(error) else type(error).__name__
