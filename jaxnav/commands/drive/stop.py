"""`jaxnav stop`: tell a vehicle to stop, without JAX, whatever else has become of its drive."""

import math
import os
import threading
from pathlib import Path
from types import SimpleNamespace
from typing import Any

from jaxnav.commands.drive.arguments import Stop
from jaxnav.commands.kinds import key_values
from jaxnav.drive import plugins
from jaxnav.drive.guard import HEARD_WITHIN_S, Guard
from jaxnav.drive.guard_process import CanNotMoveError, opened
from jaxnav.drive.interfaces import SharesProcess
from jaxnav.drive.limits import limits_of
from jaxnav.errors import BadInput, visible
from jaxnav.files import calib_dir
from jaxnav.files.reading import read_mapping

_NOT_HEARD = 1
_OPENS_WITHIN_S = 30.0  # as the doctor waits for a driver
# What a driver may ask of a vehicle, with the values of files that leave it out; None: no file may.
_CAR = {
    "wheelbase_m": None, "steering_limit_rad": None, "throttle_limit": None,
    "speed_per_throttle_mps": None, "speed_time_constant_s": None, "steering_rate_limit_radps": 5.0,
    "speed_scale": 1.0, "steering_gain": 1.0, "steering_offset_rad": 0.0, "camera_delay_s": 0.0,
}  # fmt: skip
_BASE = {
    "forward_limit_mps": None, "left_limit_mps": 0.0, "turn_limit_radps": None,
    "time_constant_s": None,
}  # fmt: skip


def run(args: Stop) -> int:
    """Open the vehicle, stop it, and say whether it has heard."""
    factory: Any = plugins.load_factory("--car", plugins.VEHICLES, args.car)
    if isinstance(factory, SharesProcess) and factory.shares_process:
        raise BadInput("--car", f"{args.car} ends with its drive: nothing is left to stop")
    numbers = numbers_of(args.vehicle or calib_dir() / "qcar" / "vehicle.yaml")
    described: Any = SimpleNamespace(**numbers)
    options = key_values("--option", args.option)
    setup = {"vehicle": numbers, "start_pose": (0.0, 0.0, 0.0), "seed": 0, "options": options}
    giving_up = threading.Timer(_OPENS_WITHIN_S + HEARD_WITHIN_S, _give_up, [args.car])
    giving_up.daemon = True
    giving_up.start()
    try:
        vehicle = opened(factory, {"vehicle": args.car, "setup": setup})
        guard = Guard(vehicle, limits_of(described))
        guard.close()
    except CanNotMoveError as problem:
        raise BadInput(f"--car {args.car}", f"can't be opened by itself: {problem}") from None
    except BadInput as bad:
        if bad.__cause__ is None or isinstance(bad.__cause__, ImportError):
            raise
        return _say(args.car, str(bad))  # another process has it, or it is not there
    finally:
        giving_up.cancel()
    return _say(args.car, guard.unheard)


def numbers_of(path: Path) -> dict[str, float]:
    """The numbers of a vehicle's file, as plug-ins find them in `setup.vehicle`.

    It is not held against all that `load_vehicle` asks for: that takes JAX, and a file that is not
    fit to drive by is no reason not to stop.

    Raises:
        BadInput: it can't be read, or a number is missing or none.
    """
    data = read_mapping(path)
    known = _CAR if data.get("base", "ackermann") == "ackermann" else _BASE
    numbers: dict[str, float] = {}
    for key, default in known.items():
        value = data.get(key, default)
        if value is None:
            raise BadInput(f"{path}: {key}", "missing")
        if type(value) not in (int, float) or not math.isfinite(value):
            raise BadInput(f"{path}: {key}", f"must be a finite number, got {value!r:.40}")
        numbers[key] = float(value)
    return numbers


def _say(car: str, unheard: str | None) -> int:
    heard = f"{car} has heard that it must stop"
    print(heard if unheard is None else f"{car} HAS NOT HEARD THAT IT MUST STOP: {unheard}")
    return 0 if unheard is None else _NOT_HEARD


def _give_up(car: str) -> None:
    """End the process of a driver that hangs. Runs in a thread."""
    os.write(1, f"{visible(car)} HAS NOT HEARD THAT IT MUST STOP: its driver hangs\n".encode())
    os._exit(_NOT_HEARD)
