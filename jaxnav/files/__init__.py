"""Reading and writing files: rigs, cameras, markers, vehicles, routes, topics, tuned parameters.

Every file is validated before anything is built from it; an error is one `BadInput` line that
names the file and the key. Keys carry their units.

As of `jaxnav` itself, every name is imported when it is first used: `jaxnav stop` reads a file
without JAX.
"""

from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any

from jaxnav.errors import BadInput

if TYPE_CHECKING:
    from jaxnav.files.cameras import load_camera, load_rig
    from jaxnav.files.markers import load_markers, save_markers
    from jaxnav.files.params import Params, apply_params, load_params, write_params
    from jaxnav.files.rigs import save_rig
    from jaxnav.files.topics import TopicMap, load_topics
    from jaxnav.files.vehicles import Route, load_car, load_route, load_vehicle, save_vehicle
    from jaxnav.files.writing import atomic_path, atomic_write, output_folder, write_json, write_tum

__all__ = [
    "Params",
    "Route",
    "TopicMap",
    "apply_params",
    "atomic_path",
    "atomic_write",
    "calib_dir",
    "load_camera",
    "load_car",
    "load_markers",
    "load_params",
    "load_rig",
    "load_route",
    "load_topics",
    "load_vehicle",
    "output_folder",
    "save_markers",
    "save_rig",
    "save_vehicle",
    "write_json",
    "write_params",
    "write_tum",
]

_MODULES = {
    "cameras": ("load_camera", "load_rig"),
    "markers": ("load_markers", "save_markers"),
    "params": ("Params", "apply_params", "load_params", "write_params"),
    "rigs": ("save_rig",),
    "topics": ("TopicMap", "load_topics"),
    "vehicles": ("Route", "load_car", "load_route", "load_vehicle", "save_vehicle"),
    "writing": ("atomic_path", "atomic_write", "output_folder", "write_json", "write_tum"),
}


def __getattr__(name: str) -> Any:
    for module, names in _MODULES.items():
        if name in names:
            value = globals()[name] = getattr(import_module(f"{__name__}.{module}"), name)
            return value
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def calib_dir() -> Path:
    """The folder of the shipped calibration: in the package if installed, beside it in a checkout.

    Raises:
        BadInput: the installation is incomplete.
    """
    package = Path(__file__).resolve().parents[1]
    for folder in (package / "calib", package.parent / "calib"):
        if (folder / "qcar").is_dir():
            return folder
    raise BadInput(package / "calib", "missing: jaxnav is not installed completely")
