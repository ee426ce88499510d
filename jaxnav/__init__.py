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
    from jaxnav.belief.ambiguity import LowestReprojection as LowestReprojection
    from jaxnav.belief.ambiguity import Mahalanobis as Mahalanobis
    from jaxnav.belief.ambiguity import ObjectSpace as ObjectSpace
    from jaxnav.belief.ambiguity import Oracle as Oracle
    from jaxnav.belief.ambiguity import OrientationGiven as OrientationGiven
    from jaxnav.belief.ambiguity import PaperCost as PaperCost
    from jaxnav.belief.ambiguity import RatioTest as RatioTest
    from jaxnav.belief.ambiguity import Selection as Selection
    from jaxnav.belief.ambiguity import Selector as Selector
    from jaxnav.belief.ambiguity import Ungated as Ungated
    from jaxnav.belief.bicycle_kalman import BicycleKalman as BicycleKalman
    from jaxnav.belief.constant_velocity import ConstantVelocity as ConstantVelocity
    from jaxnav.belief.estimate import Belief as Belief
    from jaxnav.belief.estimate import Estimate as Estimate
    from jaxnav.belief.hypotheses import MultiHypothesis as MultiHypothesis
    from jaxnav.belief.inertial_motion import InertialMotion as InertialMotion
    from jaxnav.belief.motion import Motion as Motion
    from jaxnav.configuration import configure as configure
    from jaxnav.control import Command as Command
    from jaxnav.control import Controller as Controller
    from jaxnav.errors import BadInput as BadInput
    from jaxnav.files import load_camera as load_camera
    from jaxnav.files import load_markers as load_markers
    from jaxnav.files import load_params as load_params
    from jaxnav.files import load_rig as load_rig
    from jaxnav.files import load_route as load_route
    from jaxnav.files import load_vehicle as load_vehicle
    from jaxnav.models.bicycle import Vehicle as Vehicle
    from jaxnav.models.camera import Camera as Camera
    from jaxnav.models.gyro import Gyro as Gyro
    from jaxnav.models.markers import MarkerMap as MarkerMap
    from jaxnav.models.origin import planar_in_world as planar_in_world
    from jaxnav.models.origin import poses_in_world as poses_in_world
    from jaxnav.models.rig import CameraRig as CameraRig
    from jaxnav.models.twist_base import TwistBase as TwistBase
    from jaxnav.navigator import Navigator as Navigator
    from jaxnav.navigator import Output as Output
    from jaxnav.navigator import State as State
    from jaxnav.pose.candidates import Candidates as Candidates
    from jaxnav.pose.ippe import PosePair as PosePair
    from jaxnav.pose.ippe import ippe_square as ippe_square
    from jaxnav.pose.observation import Observation as Observation
    from jaxnav.pose.observation import Snapshot as Snapshot
    from jaxnav.pose.refine import refine_pose as refine_pose
    from jaxnav.pose.refine import solve_marker as solve_marker
    from jaxnav.pose.refine import solve_markers as solve_markers
    from jaxnav.pose.residuals import e1 as e1
    from jaxnav.pose.residuals import e2 as e2
    from jaxnav.twist_control import TwistCommand as TwistCommand
    from jaxnav.twist_control import TwistController as TwistController

    __version__: str

# The imports above tell the same to type checkers; a test holds the two together.
_MODULE_OF = {
    "BadInput": "errors",
    "Belief": "belief.estimate",
    "BicycleKalman": "belief.bicycle_kalman",
    "Camera": "models.camera",
    "CameraRig": "models.rig",
    "Candidates": "pose.candidates",
    "Command": "control",
    "ConstantVelocity": "belief.constant_velocity",
    "Controller": "control",
    "Estimate": "belief.estimate",
    "Gyro": "models.gyro",
    "InertialMotion": "belief.inertial_motion",
    "LowestReprojection": "belief.ambiguity",
    "Mahalanobis": "belief.ambiguity",
    "MarkerMap": "models.markers",
    "Motion": "belief.motion",
    "MultiHypothesis": "belief.hypotheses",
    "Navigator": "navigator",
    "ObjectSpace": "belief.ambiguity",
    "Observation": "pose.observation",
    "Oracle": "belief.ambiguity",
    "OrientationGiven": "belief.ambiguity",
    "Output": "navigator",
    "PaperCost": "belief.ambiguity",
    "PosePair": "pose.ippe",
    "RatioTest": "belief.ambiguity",
    "Selection": "belief.ambiguity",
    "Selector": "belief.ambiguity",
    "Snapshot": "pose.observation",
    "State": "navigator",
    "TwistBase": "models.twist_base",
    "TwistCommand": "twist_control",
    "TwistController": "twist_control",
    "Ungated": "belief.ambiguity",
    "Vehicle": "models.bicycle",
    "configure": "configuration",
    "e1": "pose.residuals",
    "e2": "pose.residuals",
    "ippe_square": "pose.ippe",
    "load_camera": "files",
    "load_markers": "files",
    "load_params": "files",
    "load_rig": "files",
    "load_route": "files",
    "load_vehicle": "files",
    "planar_in_world": "models.origin",
    "poses_in_world": "models.origin",
    "refine_pose": "pose.refine",
    "solve_marker": "pose.refine",
    "solve_markers": "pose.refine",
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
