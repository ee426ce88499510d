"""Arguments of the commands that simulate cars: drives, studies of many, and what is learned."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import tyro
from annotated_types import Interval

from jaxnav.commands import kinds
from jaxnav.commands.kinds import optional, require

Scenario = Literal[
    "paper",
    "static",
    "approach",
    "orbit",
    "tunnel",
    "long-tunnel",
    "kidnapped",
    "slip",
    "slip-30",
    "gyro-late",
    "miscalibrated",
    "blur",
    "late",
    "drifting-corners",
    "each-camera-off",
    "uneven-wheels",
    "everything",
    "as-told",
]
_Names = Annotated[tuple[str, ...], optional("NAME", "")]


@dataclass(frozen=True)
class Demo:
    """Drive through the paper's waypoints: a simulated car, four rendered cameras, one marker.

    Each seed is driven twice from the same start: by our method, and by what people use otherwise
    (OpenCV's corners and the first of the two IPPE poses, on the same filter), which also runs
    alongside our drive, on its images. Written to --out: report.png, a mosaic of what our cameras
    saw, summary.json, and trajectories in TUM format.
    """

    seed: kinds.Seed = 0
    """Seed of every random number: first belief, image noise, odometry noise."""
    seeds: kinds.Count = 1
    """Drive this many times, with seeds counting up from --seed, and print the success rates."""
    out: Annotated[Path, tyro.conf.arg(metavar="DIR")] = Path("demo")
    """Folder for the report."""
    selector: kinds.Selector = "multi-hypothesis"
    """Which of the two poses of a marker our method believes."""
    rig: kinds.QCarRig = None
    markers: kinds.QCarMarkers = None
    vehicle: kinds.QCarVehicle = None
    route: kinds.QCarFile = None
    """Start and waypoints; by default demo_route.yaml. The paper's start is in route.yaml."""
    params: kinds.OptionalFile = None
    """Tuned parameters, for both methods: the noise of their filter is the same."""
    blur: bool = True
    """Integrate each image over its exposure while the car moves."""
    exposure_ms: kinds.NotNegative = 10.0
    """Exposure time, ms."""
    corner_noise_px: kinds.NotNegative = 0.0
    """Spoil the corners of both methods by this much (standard deviation, px)."""
    rolling_shutter: bool = True
    """Expose the rows of an image one after the other."""
    corner_backend: kinds.Detector = "aruco"
    detector: kinds.Following = "follow"
    duration_s: kinds.Positive = 30.0
    """Give up when the car has not arrived after this simulated time, s."""
    headless: kinds.Headless = False


@dataclass(frozen=True, kw_only=True)
class ScenarioCarFiles:
    """Arguments of every command that drives through scenarios: its car, in files or by name."""

    base: Literal["ackermann", "differential", "omni"] = "ackermann"
    """What drives: the vehicle, or a base of the QCar's size that is commanded by a twist."""
    imu: Literal["none", "consumer", "tactical"] = "none"
    """The vehicle's gyro: as its file says, or one of that class, with errors drawn anew for each
    drive."""
    rig: kinds.QCarRig = None
    markers: kinds.QCarMarkers = None
    vehicle: kinds.QCarVehicle = None
    route: Annotated[Path | None, optional("FILE", "(default: the scenario's own)")] = None
    """Start and waypoints that go with another marker map."""
    headless: kinds.Headless = False

    def __post_init__(self) -> None:
        named = self.base == "ackermann" or self.vehicle is None
        require(named, "--base", f"{self.base} takes the place of --vehicle: give one of them")


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
    selector: tuple[kinds.SimulatedSelector, ...] = ("multi-hypothesis",)
    """Which pose is believed; several names, or `all`."""
    corner_noise_px: tuple[kinds.CornerSigma, ...] = (1.0,)
    """Standard deviation of the corners, one or several."""
    told_noise_px: Annotated[kinds.CornerSigma | None, optional("PX", "(default: the truth)")] = (
        None
    )
    """What the navigator is told of it."""
    seeds: kinds.Count = 100
    """How many drives."""
    seed: kinds.Seed = 0
    """The first seed."""
    params: kinds.OptionalFile = None
    """Tuned parameters, before what the scenario tells; --told-noise-px goes before both."""
    json: kinds.OptionalFile = None
    """Write all numbers, each with its 95 % interval, into this file after every row."""
    resume: kinds.Switch = False
    """Keep the rows that --json holds already."""

    def __post_init__(self) -> None:
        super().__post_init__()
        require(not self.laps or self.route is None, "--laps", "takes the place of --route")
        require(bool(self.selector), "--selector", "names no selector")
        require(bool(self.corner_noise_px), "--corner-noise-px", "holds no number")
        require(not self.resume or self.json is not None, "--resume", "needs --json")


@dataclass(frozen=True)
class TuneFilter(ScenarioCarFiles):
    """Learn the filter's noise, Q and R, from recordings or from simulated drives.

    By default it asks no truth: it makes the corners of every frame as likely as can be, given all
    that came before. Which pose of a marker is the true one is told in hindsight by the whole
    estimator, and fixed; it is told anew when the descent (BFGS) has ended, until that changes
    nothing. Of recordings the last quarter, of simulated drives other seeds, are held out and
    decide when to stop. In the end the estimators before and after run over drives that had no
    part in any of this.

    Written to --out: params.yaml, which demo, simulate, replay and run take with --params, the best
    so far at any time; report.png; summary.json. The same command goes on where it was interrupted.
    """

    recordings: Annotated[
        tyro.conf.Positional[tuple[Path, ...]], optional("RECORDING", "(default: simulated drives)")
    ] = ()
    """Drives (.mcap), or rigs: folders of TagSLAM, .npz, ROS 1 bags with --rig and --markers."""
    test: Annotated[tuple[Path, ...], optional("RECORDING")] = ()
    """Recordings to hold the result against, whole."""
    part: tuple[float, float] = (0.0, 1.0)
    """What part of every recording is learned from; the rest is held against the result."""
    scenario: Scenario = "paper"
    """What happens in simulated drives."""
    corner_noise_px: kinds.CornerSigma = 1.0
    """Of simulated drives."""
    seeds: kinds.Count = 64
    """Simulated drives to learn from."""
    held_out_seeds: kinds.Count = 32
    """Simulated drives that decide when to stop."""
    test_seeds: kinds.Count = 200
    """Simulated drives for the report."""
    seed: Annotated[int, Interval(ge=0, lt=10**6)] = 0
    """The first seed; test drives count from a million on."""
    loss: Literal["likelihood", "score", "error"] = "likelihood"
    """Likelihood of the corners, which asks no truth; density of the true pose under what is
    believed; or squared position error."""
    train: _Names = ()
    """Parameters to learn, e.g. motion.odometry_sigma corner_sigma_px; by default of a vehicle Q
    and all of R that this selector looks at, of a rig Q."""
    full: _Names = ()
    """Those that are to be whole matrices."""
    params: kinds.OptionalFile = None
    """Where to start: a file of parameters."""
    selector: kinds.Believed = "multi-hypothesis"
    steps: kinds.Count = 150
    """At most so many evaluations."""
    out: kinds.ResultsFolder = Path("tuned")

    def __post_init__(self) -> None:
        super().__post_init__()
        for flag, plain in (
            ("--base", self.base == "ackermann"),
            ("--imu", self.imu == "none"),
            ("--route", self.route is None),
        ):
            alone = plain or not self.recordings
            require(alone, flag, "is of simulated drives: recordings tell what drove")
        most = 10**6 - self.seed - self.seeds
        require(self.held_out_seeds <= most, "--seeds", "test drives count from a million on")
        begin, end = self.part
        bounds = f"must be two parts of 1, the first below the second, got {begin:g} {end:g}"
        require(0 <= begin < end <= 1, "--part", bounds)


@dataclass(frozen=True)
class TuneController(ScenarioCarFiles):
    """Learn the controller's gains from simulated drives.

    The loss of a drive is a weighed sum of the time to the last waypoint, the distance from the
    straight lines between waypoints, the effort and the jerkiness of the commands. Every step of
    Adam drives other seeds: start, noise, and the true car's lag, slip and latency are drawn anew.
    The switch from waypoint to waypoint is soft for the gradient's sake and hard in all that is
    reported; which pose of a marker is believed stays the estimator's own choice. Held-out seeds
    decide when to stop, and the report is of drives never seen before. Limits are kept.

    Written to --out: params.yaml, which demo, simulate, replay and run take with --params, the best
    so far at any time; report.png; summary.json. The same command goes on where it was interrupted.
    """

    scenario: Scenario = "paper"
    """What happens in the drives to learn from."""
    test_scenario: tuple[Scenario, ...] = ("paper", "slip", "miscalibrated")
    """What happens in the drives for the report."""
    corner_noise_px: kinds.CornerSigma = 1.0
    """Standard deviation of the corners."""
    seeds: kinds.Count = 256
    """Drives a step; from 256 on they run on all cores, in a program that compiles for minutes."""
    held_out_seeds: kinds.Count = 128
    """Drives that decide when to stop, the same in every step."""
    test_seeds: kinds.Count = 200
    """Drives of each scenario for the report."""
    seed: kinds.Seed = 0
    """Of all drives."""
    time: kinds.NotNegative = 0.03
    """Weight of the time to the last waypoint, 1/s."""
    cross_track: kinds.NotNegative = 2.0
    """Weight of the RMS distance from the straight lines, 1/m."""
    effort: kinds.NotNegative = 0.13
    """Weight of the squared commands, in parts of their limits, over time, 1/s."""
    smoothness: kinds.NotNegative = 0.045
    """Weight of the squared changes of the commands from frame to frame."""
    train: _Names = ()
    """Parameters to learn; by default of a car p1, p2, its bound, look-ahead and slowing down in
    turns, of another base its speed, how it slows down, and how fast it turns on the spot."""
    params: kinds.OptionalFile = None
    """Where to start: a file of parameters."""
    selector: kinds.Believed = "multi-hypothesis"
    steps: kinds.Count = 40
    """At most so many."""
    learning_rate: kinds.Positive = 0.25
    """Of Adam, at the first step; a tenth of it at the last."""
    out: kinds.ResultsFolder = Path("tuned")

    def __post_init__(self) -> None:
        super().__post_init__()
        require(bool(self.test_scenario), "--test-scenario", "names no scenario")
        total = self.time + self.cross_track + self.effort + self.smoothness
        require(total > 0, "--time", "is 0 as all other weights are: there is nothing to lower")


@dataclass(frozen=True)
class RunStudy:
    """Run a Monte-Carlo study: a labelled grid of parameters, many trials in every cell.

    `ambiguity` studies single frames, `drive` closed-loop drives. CONFIG is a YAML file, or the
    name of one that comes with jaxnav (`jaxnav study ambiguity list` lists them, and all that can
    vary). The result is a Zarr store that xarray opens. A study that was interrupted or killed goes
    on when the same command is given again, and ends with the same bits.
    """

    kind: tyro.conf.Positional[Literal["ambiguity", "drive"]]
    """What a trial is."""
    config: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="CONFIG")]
    """YAML file with `trials`, `axes` and what is fixed; or a name; or `list`."""
    out: Annotated[Path | None, optional("STORE", "(default: out/CONFIG.zarr)")] = None
    """Where the result goes, or goes on."""
    workers: Annotated[kinds.Count | None, optional("N", "(default: this process)", int)] = None
    """Start so many Dask workers on this machine."""
    scheduler: Annotated[str | None, optional("ADDRESS", constructor=str)] = None
    """Run on the Dask cluster with its scheduler there, e.g. tcp://127.0.0.1:8786."""
    chunk_trials: Annotated[
        kinds.Count | None, optional("N", "(default: 65536, or 256 drives)", int)
    ] = None
    """How many trials are run and written at a time. Changes no result."""
    headless: kinds.Headless = False

    def __post_init__(self) -> None:
        own = self.workers is None or self.scheduler is None
        require(own, "--scheduler", "brings its own workers")


@dataclass(frozen=True)
class StudyReliability:
    """Draw whether flip probabilities mean what they say: when it says 10 %, are 10 % flipped?

    Without RECORDING, on random views of one marker (sides of 10 to 100 px, 0 to 60 degrees, corner
    noise of 0.2 to 2 px), frame by frame. With a RECORDING that has a reference, on its detections,
    every marker by itself. Written to --out: reliability.png and summary.json.
    """

    recording: Annotated[tyro.conf.Positional[Path | None], optional("RECORDING")] = None
    """Folder, ROS 1 bag (.bag, .bag.bz2) or .npz."""
    selector: kinds.Selector = "multi-hypothesis"
    """Whose probabilities, on a recording."""
    frames: kinds.Count = 165_000
    """How many random views."""
    seed: kinds.Seed = 0
    """Of the random views."""
    out: kinds.ResultsFolder = Path("out")
    headless: kinds.Headless = False
