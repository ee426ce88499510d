"""The car that drives in the scenarios of `simulate` and `tune`, from its files."""

from dataclasses import dataclass

from jaxnav.belief.ambiguity import Selector
from jaxnav.belief.bicycle_kalman import BicycleKalman
from jaxnav.commands.kinds import ScenarioCarFiles
from jaxnav.files import Params, apply_params, calib_dir, load_markers, load_rig, load_vehicle
from jaxnav.models.bicycle import Vehicle
from jaxnav.models.markers import MarkerMap
from jaxnav.models.rig import CameraRig
from jaxnav.models.twist_base import TwistBase
from jaxnav.navigator import Navigator
from jaxnav.simulation.bases import equipped
from jaxnav.simulation.scenarios import Scenario


@dataclass(frozen=True)
class ScenarioCar:
    """The rig, markers, vehicle and parameters that all scenarios share."""

    rig: CameraRig
    markers: MarkerMap
    vehicle: Vehicle | TwistBase
    params: Params | None

    @staticmethod
    def load(files: ScenarioCarFiles, params: Params | None = None) -> "ScenarioCar":
        """Load a car from its files.

        Raises:
            BadInput: a file that is not valid.
        """
        qcar = calib_dir() / "qcar"
        vehicle = load_vehicle(files.vehicle or qcar / "vehicle.yaml")
        return ScenarioCar(
            rig=load_rig(files.rig or qcar / "rig.yaml"),
            markers=load_markers(files.markers or qcar / "markers.yaml"),
            vehicle=equipped(vehicle, files.base, files.imu),
            params=params,
        )

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
