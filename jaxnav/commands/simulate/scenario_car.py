"""The car that drives in the scenarios of `simulate` and `tune`, from its files."""

from dataclasses import dataclass

import jax
import jax.numpy as jnp

from jaxnav.commands.reading import given_files
from jaxnav.commands.simulate.arguments import ScenarioCarFiles
from jaxnav.core.filter.choose import Selector
from jaxnav.core.filter.planar import BicycleKalman
from jaxnav.core.models.geometry import T_world_vehicle_from_planar
from jaxnav.core.models.markers import MarkerMap
from jaxnav.core.models.rig import CameraRig
from jaxnav.core.models.vehicle import TwistBase, Vehicle
from jaxnav.core.navigator import Navigator
from jaxnav.errors import BadInput
from jaxnav.files import Params, Route, apply_params, load_route
from jaxnav.sim.bases import equipped
from jaxnav.sim.corners import see
from jaxnav.sim.scenarios import Scenario, on_route, scenarios


@dataclass(frozen=True)
class ScenarioCar:
    """The rig, markers, vehicle, parameters and route that all scenarios share.

    Attributes:
        route: in the map's coordinates; None where each scenario drives its own.
    """

    rig: CameraRig
    markers: MarkerMap
    vehicle: Vehicle | TwistBase
    params: Params | None
    route: Route | None = None

    @staticmethod
    def load(files: ScenarioCarFiles, params: Params | None = None) -> "ScenarioCar":
        """Load a car from its files.

        Raises:
            BadInput: a file that is not valid.
        """
        content = given_files(files, ("rig", "markers", "vehicle"), or_qcars=True)
        vehicle = equipped(content.pop("vehicle"), files.base, files.imu)
        route = None
        if files.route is not None:
            route = load_route(files.route).relative_to(content["markers"].origin_m)
        return ScenarioCar(**content, vehicle=vehicle, params=params, route=route)

    def scenario(self, name: str) -> Scenario:
        """A scenario by its name, on this car's route if it has one.

        Raises:
            BadInput: no camera sees a marker of the map from its start, where nothing would come
                of it: its own route is one before the QCar's marker.
        """
        scenario = scenarios()[name]
        if self.route is not None:
            scenario = on_route(scenario, self.route.waypoints_m, self.route.start_pose)
        start = jnp.asarray(scenario.start_pose, self.rig.cameras.focal_px.dtype)
        _, visible = jax.jit(see)(self.rig, self.markers, T_world_vehicle_from_planar(start))
        if not visible.any():
            whose = "it"
            if self.route is None:
                whose = f"the QCar's route of {name}: give one before your markers"
            raise BadInput("--route", f"no marker of the map is in view from the start of {whose}")
        return scenario

    def navigator(self, scenario: Scenario, selector: Selector) -> Navigator:
        """The navigator for a scenario; parameters override what the scenario tells.

        Raises:
            BadInput: a parameter that does not fit it.
        """
        navigator = Navigator(
            rig=self.rig,
            markers=self.markers,
            vehicle=self.vehicle,
            waypoints_m=scenario.waypoints_m,
            selector=selector,
            motion=BicycleKalman(
                self.vehicle,
                tilt_sigma_rad=scenario.told_tilt_sigma_rad,
                height_sigma_m=scenario.told_height_sigma_m,
            ),
        )
        return navigator if self.params is None else apply_params(navigator, self.params)
