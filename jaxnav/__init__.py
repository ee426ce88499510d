"""One square marker, several cameras, one pure function: localise and drive a vehicle.

    import jaxnav as jn

    rig = jn.load_rig("calib/qcar/rig.yaml")
    navigator = jn.Navigator(rig=rig, markers=..., vehicle=..., waypoints_m=..., ...)
    state, out = navigator.step(navigator.init(), jn.Observation(...))

Every public name is imported when it is first used (PEP 562), so that `import jaxnav` and
`jaxnav --help` load neither JAX nor OpenCV.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from jaxnav.ambiguity import LowestReprojection as LowestReprojection
    from jaxnav.ambiguity import Mahalanobis as Mahalanobis
    from jaxnav.ambiguity import ObjectSpace as ObjectSpace
    from jaxnav.ambiguity import Oracle as Oracle
    from jaxnav.ambiguity import OrientationGiven as OrientationGiven
    from jaxnav.ambiguity import PaperCost as PaperCost
    from jaxnav.ambiguity import RatioTest as RatioTest
    from jaxnav.bicycle import Vehicle as Vehicle
    from jaxnav.bicycle_kalman import BicycleKalman as BicycleKalman
    from jaxnav.camera import Camera as Camera
    from jaxnav.constant_velocity import ConstantVelocity as ConstantVelocity
    from jaxnav.errors import BadInput as BadInput
    from jaxnav.files import load_camera as load_camera
    from jaxnav.files import load_markers as load_markers
    from jaxnav.files import load_params as load_params
    from jaxnav.files import load_rig as load_rig
    from jaxnav.files import load_route as load_route
    from jaxnav.files import load_vehicle as load_vehicle
    from jaxnav.hypotheses import MultiHypothesis as MultiHypothesis
    from jaxnav.ippe import PosePair as PosePair
    from jaxnav.ippe import ippe_square as ippe_square
    from jaxnav.markers import MarkerMap as MarkerMap
    from jaxnav.navigator import Navigator as Navigator
    from jaxnav.navigator import Observation as Observation
    from jaxnav.origin import planar_in_world as planar_in_world
    from jaxnav.origin import poses_in_world as poses_in_world
    from jaxnav.refine import refine_pose as refine_pose
    from jaxnav.refine import solve_marker as solve_marker
    from jaxnav.refine import solve_markers as solve_markers
    from jaxnav.residuals import e1 as e1
    from jaxnav.residuals import e2 as e2
    from jaxnav.rig import CameraRig as CameraRig

    __version__: str

# The imports above tell the same to type checkers; a test holds the two together.
_MODULE_OF = {
    "BadInput": "errors",
    "BicycleKalman": "bicycle_kalman",
    "Camera": "camera",
    "CameraRig": "rig",
    "ConstantVelocity": "constant_velocity",
    "LowestReprojection": "ambiguity",
    "Mahalanobis": "ambiguity",
    "MarkerMap": "markers",
    "MultiHypothesis": "hypotheses",
    "Navigator": "navigator",
    "ObjectSpace": "ambiguity",
    "Observation": "navigator",
    "Oracle": "ambiguity",
    "OrientationGiven": "ambiguity",
    "PaperCost": "ambiguity",
    "PosePair": "ippe",
    "RatioTest": "ambiguity",
    "Vehicle": "bicycle",
    "e1": "residuals",
    "e2": "residuals",
    "ippe_square": "ippe",
    "load_camera": "files",
    "load_markers": "files",
    "load_params": "files",
    "load_rig": "files",
    "load_route": "files",
    "load_vehicle": "files",
    "planar_in_world": "origin",
    "poses_in_world": "origin",
    "refine_pose": "refine",
    "solve_marker": "refine",
    "solve_markers": "refine",
}

__all__ = sorted(_MODULE_OF)


def __getattr__(name: str) -> Any:
    if name == "__version__":
        from importlib.metadata import version

        value: Any = version("jaxnav")
    elif name in _MODULE_OF:
        value = getattr(import_module(f"jaxnav.{_MODULE_OF[name]}"), name)
    else:
        raise AttributeError(f"module 'jaxnav' has no attribute {name!r}")
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *_MODULE_OF, "__version__"})
