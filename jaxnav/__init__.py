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
    from jaxnav.core.control import Command as Command
    from jaxnav.core.control import Controller as Controller
    from jaxnav.core.control import TwistCommand as TwistCommand
    from jaxnav.core.control import TwistController as TwistController
    from jaxnav.core.filter.choose import LowestReprojection as LowestReprojection
    from jaxnav.core.filter.choose import Mahalanobis as Mahalanobis
    from jaxnav.core.filter.choose import ObjectSpace as ObjectSpace
    from jaxnav.core.filter.choose import Oracle as Oracle
    from jaxnav.core.filter.choose import OrientationGiven as OrientationGiven
    from jaxnav.core.filter.choose import PaperCost as PaperCost
    from jaxnav.core.filter.choose import RatioTest as RatioTest
    from jaxnav.core.filter.choose import Selection as Selection
    from jaxnav.core.filter.choose import Selector as Selector
    from jaxnav.core.filter.choose import Ungated as Ungated
    from jaxnav.core.filter.estimate import Belief as Belief
    from jaxnav.core.filter.estimate import Estimate as Estimate
    from jaxnav.core.filter.free import ConstantVelocity as ConstantVelocity
    from jaxnav.core.filter.hypotheses import MultiHypothesis as MultiHypothesis
    from jaxnav.core.filter.imu import InertialMotion as InertialMotion
    from jaxnav.core.filter.motion import Motion as Motion
    from jaxnav.core.filter.planar import BicycleKalman as BicycleKalman
    from jaxnav.core.models.camera import Camera as Camera
    from jaxnav.core.models.imu import Gyro as Gyro
    from jaxnav.core.models.markers import MarkerMap as MarkerMap
    from jaxnav.core.models.origin import planar_in_world as planar_in_world
    from jaxnav.core.models.origin import poses_in_world as poses_in_world
    from jaxnav.core.models.rig import CameraRig as CameraRig
    from jaxnav.core.models.vehicle import TwistBase as TwistBase
    from jaxnav.core.models.vehicle import Vehicle as Vehicle
    from jaxnav.core.navigator import Navigator as Navigator
    from jaxnav.core.navigator import Output as Output
    from jaxnav.core.navigator import State as State
    from jaxnav.core.pose.ippe import PosePair as PosePair
    from jaxnav.core.pose.ippe import ippe_square as ippe_square
    from jaxnav.core.pose.observation import Observation as Observation
    from jaxnav.core.pose.observation import Snapshot as Snapshot
    from jaxnav.core.pose.refine import Candidates as Candidates
    from jaxnav.core.pose.refine import refine_pose as refine_pose
    from jaxnav.core.pose.refine import solve_marker as solve_marker
    from jaxnav.core.pose.refine import solve_markers as solve_markers
    from jaxnav.core.pose.residuals import e1 as e1
    from jaxnav.core.pose.residuals import e2 as e2
    from jaxnav.errors import BadInput as BadInput
    from jaxnav.files import load_camera as load_camera
    from jaxnav.files import load_markers as load_markers
    from jaxnav.files import load_params as load_params
    from jaxnav.files import load_rig as load_rig
    from jaxnav.files import load_route as load_route
    from jaxnav.files import load_vehicle as load_vehicle
    from jaxnav.files.configuration import configure as configure

    __version__: str

# The imports above tell the same to type checkers; a test holds the two together.
_MODULE_OF = {
    "BadInput": "errors",
    "Belief": "core.filter.estimate",
    "BicycleKalman": "core.filter.planar",
    "Camera": "core.models.camera",
    "CameraRig": "core.models.rig",
    "Candidates": "core.pose.refine",
    "Command": "core.control",
    "ConstantVelocity": "core.filter.free",
    "Controller": "core.control",
    "Estimate": "core.filter.estimate",
    "Gyro": "core.models.imu",
    "InertialMotion": "core.filter.imu",
    "LowestReprojection": "core.filter.choose",
    "Mahalanobis": "core.filter.choose",
    "MarkerMap": "core.models.markers",
    "Motion": "core.filter.motion",
    "MultiHypothesis": "core.filter.hypotheses",
    "Navigator": "core.navigator",
    "ObjectSpace": "core.filter.choose",
    "Observation": "core.pose.observation",
    "Oracle": "core.filter.choose",
    "OrientationGiven": "core.filter.choose",
    "Output": "core.navigator",
    "PaperCost": "core.filter.choose",
    "PosePair": "core.pose.ippe",
    "RatioTest": "core.filter.choose",
    "Selection": "core.filter.choose",
    "Selector": "core.filter.choose",
    "Snapshot": "core.pose.observation",
    "State": "core.navigator",
    "TwistBase": "core.models.vehicle",
    "TwistCommand": "core.control",
    "TwistController": "core.control",
    "Ungated": "core.filter.choose",
    "Vehicle": "core.models.vehicle",
    "configure": "files.configuration",
    "e1": "core.pose.residuals",
    "e2": "core.pose.residuals",
    "ippe_square": "core.pose.ippe",
    "load_camera": "files",
    "load_markers": "files",
    "load_params": "files",
    "load_rig": "files",
    "load_route": "files",
    "load_vehicle": "files",
    "planar_in_world": "core.models.origin",
    "poses_in_world": "core.models.origin",
    "refine_pose": "core.pose.refine",
    "solve_marker": "core.pose.refine",
    "solve_markers": "core.pose.refine",
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
