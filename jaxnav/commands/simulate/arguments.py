"""Arguments of the commands that simulate cars."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro
from annotated_types import Interval

from jaxnav.commands.kinds import (
    CornerSigma,
    Count,
    Detector,
    Following,
    Headless,
    NotNegative,
    OptionalFile,
    Positive,
    QCarFile,
    QCarMarkers,
    QCarRig,
    QCarVehicle,
    Scenario,
    ScenarioCarFiles,
    Seed,
    Selector,
    SimulatedSelector,
    Switch,
    optional,
    require,
)


@dataclass(frozen=True)
class Demo:
    """Drive through the paper's waypoints: a simulated car, four rendered cameras, one marker.

    Each seed is driven twice from the same start: by our method, and by what people use otherwise
    (OpenCV's corners and the first of the two IPPE poses, on the same filter), which also runs
    alongside our drive, on its images. Written to --out: report.png, a mosaic of what our cameras
    saw, summary.json, and trajectories in TUM format.
    """

    seed: Seed = 0
    """Seed of every random number: first belief, image noise, odometry noise."""
    seeds: Count = 1
    """Drive this many times, with seeds counting up from --seed, and print the success rates."""
    out: Annotated[Path, tyro.conf.arg(metavar="DIR")] = Path("demo")
    """Folder for the report."""
    selector: Selector = "multi-hypothesis"
    """Which of the two poses of a marker our method believes."""
    rig: QCarRig = None
    markers: QCarMarkers = None
    vehicle: QCarVehicle = None
    route: QCarFile = None
    """Start and waypoints; by default demo_route.yaml. The paper's start is in route.yaml."""
    params: OptionalFile = None
    """Tuned parameters, for both methods: the noise of their filter is the same."""
    blur: bool = True
    """Integrate each image over its exposure while the car moves."""
    exposure_ms: NotNegative = 10.0
    """Exposure time, ms."""
    corner_noise_px: NotNegative = 0.0
    """Spoil the corners of both methods by this much (standard deviation, px)."""
    rolling_shutter: bool = True
    """Expose the rows of an image one after the other."""
    corner_backend: Detector = "aruco"
    detector: Following = "follow"
    duration_s: Positive = 30.0
    """Give up when the car has not arrived after this simulated time, s."""
    headless: Headless = False


@dataclass(frozen=True)
class Simulate(ScenarioCarFiles):
    """Drive many seeds at corner level, without images, and count what became of them.

    Prints a table, one row for each selector and noise level. A drive succeeds when the true car
    has passed within 0.30 m of every waypoint in order, in 40 s (and 30 s for each lap), without
    leaving the floor, 5 x 5 m or 2 m beyond --route; parked, when its last pose is not the wrong
    one. A pose is wrong when its heading is off by more than 20 degrees. Position error and ANEES
    (3 degrees of freedom) are those of poses that are decided; on two laps also those of the poses
    after 20 s, on four those after 60 s.
    """

    scenario: Scenario = "paper"
    """What happens: the paper's drive, or one with trouble in it."""
    laps: Annotated[int, Interval(ge=0, le=100)] = 0
    """Drive this many laps before the marker, 6 m and 18 s each, instead of the scenario's
    own route, for errors that repeat: `paper` is then the clean drive to compare with."""
    selector: tuple[SimulatedSelector, ...] = ("multi-hypothesis",)
    """Which pose is believed; several names, or `all`."""
    corner_noise_px: tuple[CornerSigma, ...] = (1.0,)
    """Standard deviation of the corners, one or several."""
    told_noise_px: Annotated[CornerSigma | None, optional("PX", "(default: the truth)")] = None
    """What the navigator is told of it."""
    seeds: Count = 100
    """How many drives."""
    seed: Seed = 0
    """The first seed."""
    params: OptionalFile = None
    """Tuned parameters, before what the scenario tells; --told-noise-px goes before both."""
    json: OptionalFile = None
    """Write all numbers, each with its 95 % interval, into this file after every row."""
    resume: Switch = False
    """Keep the rows that --json holds already."""

    def __post_init__(self) -> None:
        super().__post_init__()
        require(not self.laps or self.route is None, "--laps", "takes the place of --route")
        require(bool(self.selector), "--selector", "names no selector")
        require(bool(self.corner_noise_px), "--corner-noise-px", "holds no number")
        require(not self.resume or self.json is not None, "--resume", "needs --json")
