"""Everything that a replay needs to compute the same bits as the drive.

    setup = DriveSetup(rig, markers, vehicle, route)
    pilot = setup.pilot(folder)
    recorder = Recorder(path, setup.header())

    log = read_drive(path)
    setup = DriveSetup.from_header(log.header, path)

The header is plain JSON and holds rig, markers, vehicle and parameters in the form of their files.
"""

import hashlib
import os
import platform
from dataclasses import asdict, dataclass, field, fields, replace
from importlib.metadata import version
from pathlib import Path
from typing import Annotated, Any

import cv2
import jax.numpy as jnp
from pydantic import Field, create_model, field_validator

from jaxnav.core.filter.selectors import SELECTORS, make_selector
from jaxnav.core.models.markers import MarkerMap
from jaxnav.core.models.origin import ZERO
from jaxnav.core.models.rig import CameraRig
from jaxnav.core.models.vehicle import TwistBase, Vehicle
from jaxnav.core.navigator import Navigator
from jaxnav.drive.compiled_step import compile_or_load
from jaxnav.drive.estimator import Program, advance_packed
from jaxnav.drive.health import Timeouts
from jaxnav.drive.pilot import Pilot
from jaxnav.errors import BadInput
from jaxnav.files import Params, Route, apply_params
from jaxnav.files.executables import PACKAGE, sources_digest
from jaxnav.files.markers import MarkerFile, marker_data
from jaxnav.files.rigs import RigFile, rig_data
from jaxnav.files.validation import CornerSigma, Entry, Point, Text, at, validate
from jaxnav.files.vehicles import (
    BaseFile,
    RecordedRoute,
    VehicleFile,
    as_car,
    is_base_file,
    vehicle_data,
)
from jaxnav.recordings.records import Flag

SETUP_VERSION = 1
# Folders of sources on which the bits of a drive don't depend.
_WITHOUT = (
    "calibrate", "commands", "experiments", "pictures", "recordings/other", "sim", "vehicles",
)  # fmt: skip
# The other selectors need what only a simulation has: another sensor, the truth.
PILOT_SELECTORS = tuple(name for name in SELECTORS if name not in ("orientation-given", "oracle"))

_Limit = Annotated[float, Field(strict=True, ge=0)]  # also inf: never


_timeouts: dict[str, Any] = {limit.name: (_Limit, ...) for limit in fields(Timeouts)}
TimeoutsEntry: Any = create_model("TimeoutsEntry", __base__=Entry, **_timeouts)


class SetupEntry(Entry):
    """The header of a recorded drive; see `DriveSetup`."""

    setup_version: Annotated[int, Field(strict=True)]
    rig: RigFile
    markers: MarkerFile
    origin_m: Point | None = None  # origin of the map's coordinates; maps near zero have none
    vehicle: VehicleFile
    route: RecordedRoute
    selector: Text
    corner_sigma_px: CornerSigma | None
    parameters: dict[str, Any] = Field(default_factory=dict)  # older drives have none
    timeouts: TimeoutsEntry
    float64: Flag
    relocate: Flag = True  # older drives don't say
    drives: Flag = True  # the same
    made_by: dict[str, str]

    @field_validator("selector")
    @classmethod
    def _known(cls, selector: str) -> str:
        if selector not in PILOT_SELECTORS:
            expected = ", ".join(PILOT_SELECTORS)
            raise ValueError(f"unknown {selector!r}: expected one of {expected}")
        return selector


class BaseSetupEntry(SetupEntry):
    """The header of a drive of a base that is driven by a twist."""

    vehicle: BaseFile  # type: ignore[assignment]


@dataclass(frozen=True, eq=False)
class DriveSetup:
    """The setup of a drive.

    Attributes:
        markers: coordinates of the pilot count from their `origin_m`, those of `route` from zero.
        selector: one of `PILOT_SELECTORS`.
        corner_sigma_px: of every corner along one axis; None: as each detection says.
        float64: precision of the process, in which rig, markers and vehicle are made too.
        parameters: name -> number or nested lists, in place of the navigator's own; see
            `with_params`.
        relocate: whether the car drives on from a pose that no slip explains; see `Pilot`.
        drives: whether the commands are the pilot's, or somebody else drives; see `Pilot`.
    """

    rig: CameraRig
    markers: MarkerMap
    vehicle: Vehicle | TwistBase
    route: Route
    selector: str = "multi-hypothesis"
    corner_sigma_px: float | None = None
    timeouts: Timeouts = field(default_factory=Timeouts)
    float64: bool = False
    parameters: dict[str, Any] = field(default_factory=dict)
    relocate: bool = True
    drives: bool = True
    # By their folder. Each takes over 100 MB once it is loaded, and goes with the setup.
    _programs: dict[Path | None, Program] = field(default_factory=dict, init=False, repr=False)

    def with_params(self, params: Params) -> "DriveSetup":
        """The setup with these parameters in place of all that it had.

        What they say of cameras and sensors it says itself: errors that are learnt of a camera
        count in these sigmas.

        Raises:
            BadInput: a parameter does not fit the navigator; names file and key.
        """
        navigator = apply_params(replace(self, parameters={}).navigator(), params)
        rig = replace(self.rig, extrinsics_sigma=navigator.rig.extrinsics_sigma)
        vehicle, sigma = self.vehicle, params.values.get("motion.vehicle.sensor_sigma")
        if sigma is not None and vehicle.sensor_sigma is not None:
            vehicle = replace(vehicle, sensor_sigma=jnp.asarray(sigma, float))
        return replace(self, rig=rig, vehicle=vehicle, parameters=params.plain())

    def car(self, where: Path) -> Vehicle:
        """The vehicle, for what is for cars alone so far.

        Args:
            where: the file that it was read from.

        Raises:
            BadInput: it is another base.
        """
        return as_car(self.vehicle, where, "header.vehicle.base")

    @property
    def route_on_map(self) -> Route:
        """The route in the coordinates of the markers."""
        return self.route.relative_to(self.markers.origin_m)

    def navigator(self) -> Navigator:
        """The navigator that the pilot runs."""
        navigator = Navigator(
            rig=self.rig,
            markers=self.markers,
            vehicle=self.vehicle,
            waypoints_m=self.route_on_map.waypoints_m,
            waypoint_radius_m=self.route.waypoint_radius_m,
            selector=make_selector(self.selector),
        )
        return apply_params(navigator, Params.from_values(self.parameters, Path("DriveSetup")))

    def pilot(self, folder: Path | None) -> Pilot:
        """A pilot at the beginning of a drive. All pilots of a setup share one compiled program.

        Args:
            folder: folder of executables, see `compile_or_load`.
        """
        navigator = self.navigator()
        if folder not in self._programs:
            self._programs[folder] = compile_or_load(advance_packed, navigator, folder)
        return Pilot(
            navigator,
            self.timeouts,
            self._programs[folder],
            self.corner_sigma_px,
            self.relocate,
            self.drives,
            self.route.leaves_at_m,
        )

    def header(self) -> dict[str, Any]:
        """The setup with every number bit for bit, and a description of this process."""
        header = {
            "setup_version": SETUP_VERSION,
            "rig": rig_data(self.rig),
            "markers": marker_data(self.markers),
            "vehicle": vehicle_data(self.vehicle),
            "route": {name: n for name, n in asdict(self.route).items() if n is not None},
            "selector": self.selector,
            "corner_sigma_px": self.corner_sigma_px,
            "timeouts": asdict(self.timeouts),
            "float64": self.float64,
            "made_by": this_process(),
        }
        # A header without these fields can be read by any version of the program.
        if self.parameters:
            header["parameters"] = dict(self.parameters)
        if self.markers.origin_m != ZERO:
            header["origin_m"] = list(self.markers.origin_m)
        # So can one in which these are as they always were.
        others = {"relocate": self.relocate, "drives": self.drives}
        return header | {name: False for name, value in others.items() if not value}

    @staticmethod
    def from_header(header: dict[str, Any], where: Path) -> "DriveSetup":
        """The setup of a `header`. The process must have its precision, see `needs_float64`.

        Args:
            where: the file of the header.

        Raises:
            BadInput: one line naming file and key; also where the header has a newer version.
        """
        entry = _checked(header, where)
        x_m, y_m, z_m = entry.origin_m or ZERO
        setup = DriveSetup(
            rig=entry.rig.rig(),
            markers=entry.markers.map((x_m, y_m, z_m)),
            vehicle=entry.vehicle.vehicle(),
            route=entry.route.route(),
            selector=entry.selector,
            corner_sigma_px=entry.corner_sigma_px,
            timeouts=Timeouts(**entry.timeouts.model_dump()),
            float64=entry.float64,
            relocate=entry.relocate,
            drives=entry.drives,
        )
        if not entry.parameters:
            return setup
        return setup.with_params(Params.from_values(entry.parameters, where, prefix="header"))


def needs_float64(header: dict[str, Any], where: Path) -> bool:
    """Whether a recorded drive needs float64; makes no array.

    Raises:
        BadInput: as `DriveSetup.from_header`.
    """
    return _checked(header, where).float64


def made_here(header: dict[str, Any]) -> bool:
    """Whether this machine and these versions recorded a drive, so a replay has the same bits."""
    return bool(header.get("made_by") == this_process())


def this_process() -> dict[str, str]:
    """All on which the bits of a result depend beside the setup: versions, machine, settings."""
    libraries = ("jaxnav", "jax", "jaxlib", "jaxlie", "equinox", "optimistix", "lineax", "numpy")
    return {name: version(name) for name in libraries} | {
        "opencv": str(cv2.__version__),
        "python": platform.python_version(),
        "machine": platform.machine(),
        "host": hashlib.blake2b(platform.node().encode(), digest_size=8).hexdigest(),
        "sources": sources_digest(PACKAGE, _WITHOUT),
        "XLA_FLAGS": os.environ.get("XLA_FLAGS", ""),
        "PJRT_NPROC": os.environ.get("PJRT_NPROC", ""),
    }


def _checked(header: dict[str, Any], where: Path) -> SetupEntry:
    setup_version = header.get("setup_version")
    if isinstance(setup_version, int) and setup_version != SETUP_VERSION:
        problem = f"this program reads {SETUP_VERSION}, the file has {setup_version}"
        raise BadInput(at(where, "header.setup_version"), problem)
    vehicle = header.get("vehicle")
    of_base = isinstance(vehicle, dict) and is_base_file(vehicle)
    return validate(BaseSetupEntry if of_base else SetupEntry, header, where, "header")
